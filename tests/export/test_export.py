"""`photonfarm export`: each format holds what the store has, to the bit; it goes on where it was killed, and grows."""

import io
import json
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import mlcroissant
import numpy as np
import OpenEXR
import pytest
import store_samples as samples
import yaml
from pyarrow import parquet

from photonfarm.data import Sample, open_scene
from photonfarm.export.export import Result, export_scene
from photonfarm.export.rows import ranges, rows_in, spans
from photonfarm.export.settings import ExportRequest
from photonfarm.shared.cli.main import main
from photonfarm.shared.core.errors import CorruptError, IncompleteError, SpecError, StoreError
from photonfarm.shared.plan.request import Request
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.scene.view import Camera
from photonfarm.shared.store import SceneStore, Store

FORMATS = ("webdataset", "exr", "npz", "parquet")
BRIGHT = 3  # a row whose radiance float16 cannot hold


def planned(place: str | Path, *, views: int = 1, modifications: int = 10, **changes: Any) -> SceneStore:
    """A scene with jobs of 2 samples, and its base."""
    store = Store(place, create=True)
    request = Request(modifications=modifications, views_per_modification=views)
    scene = store.scene(store.plan(samples.small_spec(**changes), request, shard_rows=2).scene_id)
    scene.write_base(*samples.base())
    return scene


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """10 samples in jobs of 2, of 5 configurations with 2 views each, with guides; all committed."""
    place: Path = tmp_path_factory.mktemp("made") / "store"
    scene = planned(place, modifications=5, views=2)
    scene.guides.want(GuideSpec())
    for job in range(scene.jobs()):
        commit(scene, job)
    return place


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> SceneStore:
    """That scene, in a store of the test's own."""
    shutil.copytree(made, tmp_path / "store")
    (scene,) = Store(tmp_path / "store").scenes()
    return scene


def commit(scene: SceneStore, job: int) -> None:
    given = samples.outputs(scene, job)
    if BRIGHT in given.radiance:
        given.radiance[BRIGHT] *= np.float32(1e6 / 3)
    samples.commit(scene, job, given)
    if scene.guides.settings() is not None:
        samples.commit_guides(scene, job)


def exported(scene: SceneStore, out: Path, to: str, on_progress: Any = lambda *_: None, **asked: Any) -> Result:
    store = scene.folder.parent.parent
    return export_scene(store, scene.scene_id, out, ExportRequest(to=to, **asked), lambda _: None, on_progress)  # type: ignore[arg-type]


def several(to: str, number: int = 3) -> dict[str, int]:
    """The option for small files, of the formats that have it."""
    return {"samples_per_file": number} if to in ("webdataset", "parquet") else {}


# ------------------------------------------------------------------------------------ reading, by other libraries alone


def read(folder: Path, to: str) -> dict[int, dict[str, Any]]:
    """The arrays and the facts of every sample in an export, by row."""
    found = {"webdataset": tar_samples, "exr": exr_samples, "npz": npz_samples, "parquet": table_samples}[to](folder)
    by_row = {int(sample["row"]): sample for sample in found}
    assert len(by_row) == len(found)
    return by_row


def tar_samples(folder: Path) -> list[dict[str, Any]]:
    import webdataset

    shards = sorted(map(str, folder.glob("data/*.tar")))
    found = []
    for sample in webdataset.WebDataset(shards, shardshuffle=False).decode():
        arrays = {name.removesuffix(".npy"): value for name, value in sample.items() if name.endswith(".npy")}
        halves = {"A": arrays.pop("a"), "B": arrays.pop("b")}
        assert int(sample["__key__"]) == sample["json"]["row"]
        found.append({**arrays, **halves, **sample["json"]})
    return found


def exr_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("samples/*.exr")):
        with OpenEXR.File(str(file)) as image:
            layers = {name: channel.pixels for name, channel in image.channels().items()}
            facts = json.loads(image.header()["photonfarm"])
        arrays = {name: values for name, values in layers.items() if "." not in name}
        arrays |= {name.partition(".")[0]: values for name, values in layers.items() if name[-2:] in (".V", ".Z")}
        for name in {name.partition(".")[0] for name in layers if name.endswith(".X")}:
            arrays[name] = np.stack([layers[f"{name}.{axis}"] for axis in "XYZ"], axis=-1)
        np.testing.assert_array_equal(arrays.pop("RGB"), (arrays["A"] + arrays["B"]) / np.float32(2))
        if file.with_suffix(".npz").exists():
            with np.load(file.with_suffix(".npz")) as beside:
                arrays |= dict(beside)
        found.append({**arrays, **facts})
    return found


def npz_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("samples/*.npz")):
        with np.load(file, allow_pickle=False) as archive:
            found.append({name: values if values.shape else values.item() for name, values in archive.items()})
    return found


def table_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("data/*.parquet")):
        found += parquet.read_table(file).to_pylist()
    return found


GUIDES = tuple(samples.guides(samples.small_spec(), 0).__dataclass_fields__)


@pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)  # webdataset's
@pytest.mark.parametrize("to", FORMATS)
def test_what_is_read_without_photonfarm_is_what_the_store_has_to_the_bit(
    scene: SceneStore, tmp_path: Path, to: str
) -> None:
    result = exported(scene, tmp_path / "out", to, extras=("visibility",), **several(to))
    assert (result.samples, result.new) == (10, 10)
    found = read(tmp_path / "out", to)
    opened = open_scene(scene.folder.parent.parent, scene.scene_id)
    held_out = set(opened.split("held-out").rows.tolist())
    assert sorted(found) == opened.rows.tolist()
    for sample in opened:
        check_sample(found[sample.row], sample, to)
        assert found[sample.row]["split"] == ("held-out" if sample.row in held_out else "train")
    assert np.max(found[BRIGHT]["A"]) > 1e5


def check_sample(there: dict[str, Any], sample: Sample, to: str) -> None:
    half = "float32" if to == "parquet" else "float16"  # Python's numbers, as pyarrow gives them, have no type
    arrays = {"A": sample.radiance[0], "B": sample.radiance[1], "depth": sample.depth, **sample.guides}
    arrays |= {"albedo": sample.albedo, "normal": sample.normal}
    arrays |= {"point_seen": sample.point_cloud.seen, "photon_seen": sample.seen_photons}
    assert set(GUIDES) < set(arrays)
    for name, values in arrays.items():
        given = np.asarray(there[name], values.dtype)
        assert given.tobytes() == values.tobytes(), name
    if to != "parquet":
        types = {name: str(there[name].dtype) for name in ("A", "albedo", "normal", "roughness", "depth", "direct")}
        assert types == {"A": "float32", "albedo": half, "normal": half, "roughness": half, "depth": "float32",
                         "direct": "float32"}  # fmt: skip
    assert (there["key"], there["pass"]) == (sample.key.hex(), sample.pass_number)
    assert (there["seed_A"], there["seed_B"]) == sample.seeds
    np.testing.assert_array_equal(np.asarray(there["modification"], np.float32), sample.modification.vector)
    np.testing.assert_array_equal(np.asarray([*there["origin"], *there["target"]], np.float32), sample.view.vector)
    assert there["core_s"] == samples.FIGURES.core_s / 2


def test_archives_of_several_samples_have_them_along_the_first_axis(scene: SceneStore, tmp_path: Path) -> None:
    exported(scene, tmp_path / "out", "npz", samples_per_file=4, split="train", buffers="depth")
    opened, seen = open_scene(scene.folder.parent.parent, scene.scene_id), []
    for file in sorted(tmp_path.glob("out/data/train-*.npz")):
        with np.load(file) as archive:
            assert set(archive) >= {"A", "B", "depth", "key"}
            assert "albedo" not in archive
            for i, row in enumerate(archive["row"].tolist()):
                np.testing.assert_array_equal(archive["B"][i], opened.row(row).radiance[1])
                seen.append(row)
    assert seen == opened.split("train").rows.tolist()


def test_a_scene_in_a_bucket_is_exported_as_one_in_a_folder_is(url: str, tmp_path: Path) -> None:
    scene = planned(url, modifications=2)
    samples.commit_all(scene)
    export_scene(url, "small", tmp_path / "out", ExportRequest(to="npz"), lambda _: None, lambda *_: None)
    found = read(tmp_path / "out", "npz")
    assert sorted(found) == [0, 1]
    np.testing.assert_array_equal(found[1]["A"], samples.outputs(scene, 0).radiance[1][0])


@pytest.mark.parametrize(("rows", "text"), [([], ""), ([7], "7"), ([3, 0, 1, 2, 9, 11, 12], "0-3,9,11-12")])
def test_rows_are_written_as_ranges_and_read_back(rows: list[int], text: str) -> None:
    assert ranges(rows) == text
    assert rows_in(text) == sorted(rows)


@pytest.mark.parametrize("text", ["x", "3-1", "-1", "1-", "1:3", "1--3"])
def test_what_is_no_rows_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no row"):
        spans(text)


# --------------------------------------------------------------------------------------------- going on, and growing

KILLED = """
import os, sys
from pathlib import Path
from photonfarm.export.export import export_scene
from photonfarm.export.settings import ExportRequest

def progress(done, total, size):
    if done == 5:
        os._exit(9)

request = ExportRequest(to=sys.argv[4], samples_per_file=int(sys.argv[5]) or None, extras=("points",))
export_scene(sys.argv[1], sys.argv[2], Path(sys.argv[3]), request, print, progress)
"""


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of the files of an export, but for what holds times, and for its lock."""
    files = [file for file in folder.rglob("*") if file.is_file() and file.name != ".lock"]
    return {str(file.relative_to(folder)): b"" if file.suffix == ".npz" else file.read_bytes() for file in files}


@pytest.mark.parametrize("to", FORMATS)
def test_a_killed_export_goes_on_and_ends_as_if_it_had_not_been_killed(
    scene: SceneStore, tmp_path: Path, to: str
) -> None:
    store, per_file = scene.folder.parent.parent, several(to).get("samples_per_file", 0)
    arguments = map(str, (store, scene.scene_id, tmp_path / "killed" / "out", to, per_file))
    assert subprocess.run([sys.executable, "-c", KILLED, *arguments]).returncode == 9
    left = contents(tmp_path / "killed/out")
    assert not json.loads(left["export.json"])["complete"]
    there = {name: (tmp_path / "killed/out" / name).stat().st_mtime_ns for name in left if "partial" not in name}
    result = exported(scene, tmp_path / "killed/out", to, extras=("points",), **several(to))
    assert result.samples == 10
    assert result.new == 10 - (4 if per_file == 0 else 3)
    exported(scene, tmp_path / "whole/out", to, extras=("points",), **several(to))
    assert contents(tmp_path / "killed/out") == contents(tmp_path / "whole/out")
    kept = [name for name in there if name.startswith(("samples", "data", "configurations"))]
    assert kept
    assert all((tmp_path / "killed/out" / name).stat().st_mtime_ns == there[name] for name in kept)


@pytest.mark.parametrize("to", FORMATS)
def test_a_later_export_takes_only_what_is_new(tmp_path: Path, to: str) -> None:
    scene = planned(tmp_path / "store")
    out = tmp_path / "out"
    with pytest.raises(IncompleteError):
        exported(scene, out, to)
    for job in (0, 2):
        commit(scene, job)
    assert exported(scene, out, to, **several(to)).new == 4
    before = {file: file.read_bytes() for file in (*out.glob("data/*"), *out.glob("samples/*"))}
    assert exported(scene, out, to, **several(to)).new == 0
    for job in (1, 3, 4):
        commit(scene, job)
    result = exported(scene, out, to, **several(to))
    assert (result.samples, result.new) == (10, 6)
    assert {file: file.read_bytes() for file in before} == before
    if to != "webdataset":
        assert sorted(read(out, to)) == list(range(10))
    manifest = json.loads((out / "export.json").read_text())
    assert (manifest["complete"], manifest["rows"], manifest["jobs"]) == (True, "0-9", "0-4")
    assert sorted(row for part in manifest["parts"] for row in rows_in(part["rows"])) in ([], list(range(10)))


def test_a_sample_whose_bytes_are_damaged_ends_it_and_is_exported_once_it_is_mended(
    scene: SceneStore, tmp_path: Path
) -> None:
    (file,) = scene.folder.glob("plans/000000/albedo/c.2.*")
    whole = file.read_bytes()
    file.write_bytes(whole[:100] + bytes([whole[100] ^ 1]) + whole[101:])
    with pytest.raises(CorruptError):
        exported(scene, tmp_path / "out", "npz")
    assert len(read(tmp_path / "out", "npz")) == 4
    file.write_bytes(whole)
    assert exported(scene, tmp_path / "out", "npz").new == 6


# ----------------------------------------------------------------------------------------------------- what is refused


def test_a_folder_that_holds_something_else_is_refused_and_stays_as_it_is(scene: SceneStore, tmp_path: Path) -> None:
    out = tmp_path / "out"
    exported(scene, out, "npz", rows="0-3")
    others = [planned(tmp_path / "other"), planned(tmp_path / "store", name="large", points=8)]
    for other in others:
        samples.commit_all(other)
    before = contents(out)
    for changed in ({"to": "exr"}, {"buffers": "none"}, {"samples_per_file": 2}, {"extras": ("points",)},
                    {"hold_out": 0.5}):  # fmt: skip
        with pytest.raises(StoreError):
            exported(scene, out, **{"to": "npz", **changed})
    for other in others:
        with pytest.raises(StoreError):
            exported(other, out, "npz", buffers=",".join(("albedo", "normal", "depth")))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("do not touch")
    with pytest.raises(StoreError):
        exported(scene, tmp_path / "mine", "npz")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.txt"]
    (out / "export.json").write_text("{}")
    with pytest.raises(StoreError):
        exported(scene, out, "npz")
    assert contents(out) == {**before, "export.json": b"{}"}


def test_two_exports_into_one_folder_do_not_meet(scene: SceneStore, tmp_path: Path) -> None:
    refused = []

    def progress(*_: int) -> None:
        with pytest.raises(StoreError) as error:
            exported(scene, tmp_path / "out", "npz")
        refused.append(error.value)

    assert exported(scene, tmp_path / "out", "npz", progress).new == 10
    assert len(refused) == 10


@pytest.mark.parametrize("asked", [{"buffers": "albdo"}, {"to": "exr", "samples_per_file": 2}])
def test_what_cannot_be_is_refused_before_a_folder_is_made(
    scene: SceneStore, tmp_path: Path, asked: dict[str, Any]
) -> None:
    with pytest.raises(SpecError):
        exported(scene, tmp_path / "out", **{"to": "npz", **asked})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("to", "package"), [("exr", "OpenEXR"), ("parquet", "pyarrow")])
def test_a_missing_package_is_named_before_a_folder_is_made(
    scene: SceneStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(StoreError, match=rf"{package}.*photonfarm-shared\[export\]"):
        exported(scene, tmp_path / "out", to)
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------- guides, and extras


def test_guides_are_said_to_be_missing_and_only_samples_that_have_them_are_exported_with_them(tmp_path: Path) -> None:
    scene = planned(tmp_path / "store", modifications=5)
    samples.commit_all(scene)
    said: list[str] = []
    store, request = scene.folder.parent.parent, ExportRequest(to="npz")
    export_scene(store, "small", tmp_path / "without", request, said.append, lambda *_: None)
    assert any("without guides" in line for line in said)
    assert "direct" not in read(tmp_path / "without", "npz")[0]
    with pytest.raises(SpecError):
        exported(scene, tmp_path / "out", "npz", buffers="albedo,direct")
    scene.guides.want(GuideSpec())
    samples.commit_guides(scene, 1)
    assert exported(scene, tmp_path / "with", "npz").samples == 2
    assert exported(scene, tmp_path / "few", "npz", buffers="albedo").samples == 5
    with pytest.raises(StoreError):  # its folder is without guides
        exported(scene, tmp_path / "without", "npz")


def test_points_and_photons_are_exported_once_per_configuration(scene: SceneStore, tmp_path: Path) -> None:
    result = exported(scene, tmp_path / "out", "webdataset", extras=("points", "photons"))
    opened = open_scene(scene.folder.parent.parent, scene.scene_id)
    keys = {sample.modification.key(scene.scene_id).hex(): sample for sample in opened}
    assert result.configurations == len(keys) < 10
    assert {file.stem for file in (tmp_path / "out/configurations").iterdir()} == set(keys)
    for key, sample in keys.items():
        with np.load(tmp_path / f"out/configurations/{key}.npz") as found:
            np.testing.assert_array_equal(found["modification"], sample.modification.vector)
            for name in ("position", "normal", "albedo", "emission", "present"):
                np.testing.assert_array_equal(found[f"point_{name}"], getattr(sample.point_cloud, name))
            for name in ("position", "direction", "normal", "power", "bounce"):
                np.testing.assert_array_equal(found[f"photon_{name}"], getattr(sample.photons, name))


# ----------------------------------------------------------------------------------------------- what describes it all


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


# ------------------------------------------------------------------------------------------------------- the verb


def test_the_verb_exports_and_ends_with_its_exit_codes(
    scene: SceneStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def ended(*arguments: str | Path) -> int | str | None:
        with pytest.raises(SystemExit) as error:  # an error that is not ours comes through
            main(["export", *map(str, arguments), "--store", str(scene.folder.parent.parent)])
        return error.value.code

    out = ("--out", tmp_path / "out")
    assert not ended("small", "--to", "webdataset", *out, "--with", "points,visibility", "--json")
    printed = capsys.readouterr()
    assert json.loads(printed.out)["new"] == 10
    assert "10/10 samples" in printed.err
    for code, arguments in (
        (4, ("small", "--to", "npz", *out)),
        (4, ("large", "--to", "npz", *out)),
        (3, ("nowhere.toml", "--to", "npz", *out)),
        (2, ("small", "--to", "npz", *out, "--rows", "5-3")),
        (2, ("small", "--to", "npz", *out, "--with", "pionts")),
        (7, ("small", "--to", "npz", "--out", tmp_path / "none", "--rows", "100-200")),
    ):
        assert ended(*arguments) == code, arguments


def test_a_shard_is_an_ordinary_tar_file(scene: SceneStore, tmp_path: Path) -> None:
    exported(scene, tmp_path / "out", "webdataset", buffers="depth", rows="4", split="all")
    (shard,) = tmp_path.glob("out/data/*.tar")
    with tarfile.open(shard) as found:
        assert found.getnames() == [f"00000004.{name}" for name in ("A.npy", "B.npy", "depth.npy", "json")]
        content = found.extractfile("00000004.depth.npy")
        assert content is not None
        depth = np.load(io.BytesIO(content.read()))
    np.testing.assert_array_equal(depth, open_scene(scene.folder.parent.parent, "small").row(4).depth)
