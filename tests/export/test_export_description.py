"""What describes an export: its cameras, its manifest, its card and its metadata."""

import json
from pathlib import Path

import mlcroissant
import numpy as np
import pytest
import store_samples as samples
import yaml
from exports import commit, exported, planned, read, several

from photonfarm.data import open_scene
from photonfarm.scene.shot_files import read_cameras
from photonfarm.scene.view import Camera
from photonfarm.store import SceneStore


def test_the_cameras_of_transforms_show_what_the_samples_show(scene: SceneStore, tmp_path: Path) -> None:
    exported(scene, tmp_path / "out", "exr", buffers="none", split="train")
    document = json.loads((tmp_path / "out/transforms.json").read_text())
    opened = open_scene(scene.folder.parent.parent, scene.scene_id).split("train")
    assert len(document["frames"]) == len(opened)
    intrinsics = np.array([[document["fl_x"], 0, document["cx"]], [0, document["fl_y"], document["cy"]], [0, 0, 1]])
    for frame, sample in zip(document["frames"], opened, strict=True):
        assert (tmp_path / "out" / frame["file_path"]).is_file()
        assert frame["split"] == "train"
        world_to_camera = np.linalg.inv(frame["transform_matrix"])
        camera = Camera.of(sample.view, opened.spec)
        ray, pixel = camera.rays()[2, 6], (6.5, 2.5)  # row 2 from above, column 6 from the left
        x, y, z, _ = world_to_camera @ np.append(camera.origin + 3 * ray, 1)
        u, v, w = intrinsics @ (x, -y, -z)
        np.testing.assert_allclose((u / w, v / w), pixel, atol=1e-4)
    assert document["camera_angle_x"] == pytest.approx(2 * np.arctan(document["cx"] / document["fl_x"]))


@pytest.mark.parametrize("to", ["exr", "npz", "parquet"])
def test_a_field_of_view_of_each_view_is_exported(tmp_path: Path, to: str) -> None:
    """It comes back as the same cameras."""
    view = samples.small_spec().view.model_dump() | {"fov": {"min": 40, "max": 80}}
    scene = planned(tmp_path / "store", modifications=2, view=view, **samples.ALWAYS)
    commit(scene, 0)
    exported(scene, tmp_path / "out", to, buffers="none", **several(to))
    wanted = scene.plans()[0].rows.view[:2]
    for row, found in read(tmp_path / "out", to).items():
        assert float(found["fov"]) == wanted[row, 6]
    assert "40° to 80°" in (tmp_path / "out/README.md").read_text()
    if to == "exr":
        cameras = read_cameras(tmp_path / "out/transforms.json", scene.spec)
        np.testing.assert_array_equal([camera.vector for camera in cameras], wanted)


def test_the_manifest_says_where_the_samples_came_from(scene: SceneStore, tmp_path: Path) -> None:
    exported(scene, tmp_path / "out", "npz", rows="2-5")
    found = json.loads((tmp_path / "out/export.json").read_text())
    assert (found["scene"], found["rows"], found["samples"]) == ({"id": scene.scene_id, "name": "small"}, "2-5", 4)
    assert found["jobs"] == "1-2"
    assert [plan["request"]["modifications"] for plan in found["plans"]] == [5]
    assert found["versions"]["rendered_by"] == [dict(samples.FIGURES.versions)]
    assert {column["name"]: column["shape"] for column in found["columns"]}["albedo"] == [8, 8, 3]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what mlcroissant uses
@pytest.mark.parametrize("licence", ["CC-BY-3.0", "ask the studio", None])
def test_the_card_has_licence_and_credits_and_croissant_is_valid(tmp_path: Path, licence: str | None) -> None:
    stated = {"title": "A room", "author": "Some Body", "licence": licence, "source": "https://example.org/room"}
    scene = planned(tmp_path / "store", modifications=12, **({"credits": stated} if licence else {}))
    samples.commit_all(scene)
    exported(scene, tmp_path / "out", "parquet", **several("parquet"), hold_out=0.4)
    card = (tmp_path / "out/README.md").read_text()
    front = yaml.safe_load(card.split("---\n")[1])
    assert front["license"] == ("cc-by-3.0" if licence == "CC-BY-3.0" else "other")
    assert front.get("license_name") == (licence if licence == "ask the studio" else None)
    assert [each["split"] for each in front["configs"][0]["data_files"]] == ["train", "held_out"]
    assert ("Some Body" in card) == (licence is not None)
    dataset = mlcroissant.Dataset(str(tmp_path / "out/croissant.json"))
    records = {record["samples/row"]: record for record in dataset.records("samples")}
    assert sorted(records) == list(range(12))
    assert dataset.metadata.license == [licence or "unknown"]
    opened = open_scene(tmp_path / "store", "small")
    np.testing.assert_array_equal(np.asarray(records[3]["samples/A"], np.float32), opened[3].radiance[0])
