"""The folder of an export: it goes on where it was killed, grows, and holds nothing else."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples
from exports import FORMATS, commit, exported, planned, read, several

from photonfarm.core.errors import CorruptError, IncompleteError, SpecError, StoreError
from photonfarm.export.snapshot import parse_rows
from photonfarm.store import SceneStore

# --------------------------------------------------------------------------------------------- going on, and growing

KILLED = """
import os, sys
from pathlib import Path
from photonfarm.export.export import export_scene
from photonfarm.export.folder import ExportRequest

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


@pytest.mark.parametrize("to", ["webdataset", "exr"])
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
    scene = planned(tmp_path / "store", **samples.ALWAYS)
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
    assert sorted(row for part in manifest["parts"] for row in parse_rows(part["rows"])) in ([], list(range(10)))


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


def test_samples_that_a_repair_takes_back_stay_in_an_export_and_are_described(tmp_path: Path) -> None:
    scene = planned(tmp_path / "store")
    samples.commit_all(scene)
    exported(scene, tmp_path / "out", "exr")
    cameras = (tmp_path / "out/transforms.json").read_bytes()
    (scene.folder / "committed/000000000001.json").unlink()
    assert exported(scene, tmp_path / "out", "exr").samples == 10
    assert (tmp_path / "out/transforms.json").read_bytes() == cameras


# ----------------------------------------------------------------------------------------------------- what is refused


def test_a_folder_that_holds_something_else_is_refused_and_stays_as_it_is(scene: SceneStore, tmp_path: Path) -> None:
    out = tmp_path / "out"
    exported(scene, out, "npz", rows="0-3")
    others = [planned(tmp_path / "other"), planned(tmp_path / "store", name="large", points=8)]
    for other in others:
        samples.commit_all(other)
    before = contents(out)
    for changed in (
        {"to": "exr"},
        {"buffers": "none"},
        {"samples_per_file": 2},
        {"extras": ("points",)},
        {"hold_out": 0.5},
    ):
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
    with pytest.raises(StoreError, match=rf"{package}.*'\.\[export\]'"):
        exported(scene, tmp_path / "out", to)
    assert not (tmp_path / "out").exists()
