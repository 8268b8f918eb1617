"""`photonfarm export`: each format holds what the store has, to the bit, also of guides and extras."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from exports import BRIGHT, FORMATS, exported, planned, read, several

from photonfarm.cli.main import main
from photonfarm.data import Sample, open_scene
from photonfarm.export.export import export_scene
from photonfarm.export.folder import ExportRequest
from photonfarm.export.snapshot import format_ranges, parse_ranges, parse_rows
from photonfarm.store import SceneStore

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
    arrays = {"A": sample.radiance[0], "B": sample.radiance[1], **sample.images}
    arrays |= {"point_seen": sample.point_cloud.seen, "photon_seen": sample.seen_photons}
    assert set(GUIDES) < set(arrays)
    for name, values in arrays.items():
        given = np.asarray(there[name], values.dtype)
        assert given.tobytes() == values.tobytes(), name
    if to != "parquet":
        types = {name: str(there[name].dtype) for name in ("A", "albedo", "normal", "roughness", "depth", "direct")}
        assert types == {
            "A": "float32",
            "albedo": half,
            "normal": half,
            "roughness": half,
            "depth": "float32",
            "direct": "float32",
        }
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
    assert format_ranges(rows) == text
    assert parse_rows(text) == sorted(rows)


@pytest.mark.parametrize("text", ["x", "3-1", "-1", "1-", "1:3", "1--3"])
def test_what_is_no_rows_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no row"):
        parse_ranges(text)


def test_a_shard_is_an_ordinary_tar_file(scene: SceneStore, tmp_path: Path) -> None:
    exported(scene, tmp_path / "out", "webdataset", buffers="depth", rows="4", split="all")
    (shard,) = tmp_path.glob("out/data/*.tar")
    with tarfile.open(shard) as found:
        assert found.getnames() == [f"00000004.{name}" for name in ("A.npy", "B.npy", "depth.npy", "json")]
        content = found.extractfile("00000004.depth.npy")
        assert content is not None
        depth = np.load(io.BytesIO(content.read()))
    np.testing.assert_array_equal(depth, open_scene(scene.folder.parent.parent, "small").row(4).depth)


# -------------------------------------------------------------------------------------------------------- extras


def test_points_and_photons_are_exported_once_per_configuration(scene: SceneStore, tmp_path: Path) -> None:
    result = exported(scene, tmp_path / "out", "webdataset", extras=("points", "photons"))
    opened = open_scene(scene.folder.parent.parent, scene.scene_id)
    keys = {sample.modification.key(scene.spec.radiance_id).hex(): sample for sample in opened}
    assert result.configurations == len(keys) < 10
    assert {file.stem for file in (tmp_path / "out/configurations").iterdir()} == set(keys)
    for key, sample in keys.items():
        with np.load(tmp_path / f"out/configurations/{key}.npz") as found:
            np.testing.assert_array_equal(found["modification"], sample.modification.vector)
            for name in ("position", "normal", "albedo", "emission", "present"):
                np.testing.assert_array_equal(found[f"point_{name}"], getattr(sample.point_cloud, name))
            for name in ("position", "direction", "normal", "power", "bounce"):
                np.testing.assert_array_equal(found[f"photon_{name}"], getattr(sample.photons, name))


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
