"""`photonfarm store check` reads everything, and finds what is wrong with what was committed."""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import checked_store as stores
import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check import job_check
from photonfarm.store.format import schema
from photonfarm.store.io.local import LocalStorage

scene = stores.scene
samples, checked, found, noted = stores.samples, stores.checked, stores.found, stores.noted
shard, flip, marker, recommitted = stores.shard, stores.flip, stores.marker, stores.recommitted


# ------------------------------------------------------------------------------------------------------------- clean


def test_a_clean_store_is_clean_and_all_of_it_is_read(store: Store, scene: SceneStore) -> None:
    report = checked(store)
    (about,) = report.scenes
    assert (report.exit_code, found(report), report.quarantine) == (0, {}, None)
    assert (about.jobs, about.samples) == (3, 10)
    assert about.size_bytes == sum(file["size"] for job in range(3) for file in scene.marker(job)["files"].values())
    assert about.halves is not None
    assert about.halves.passed


def test_a_check_changes_nothing(store: Store, scene: SceneStore) -> None:
    flip(shard(scene, "depth"), 20)
    before = {p: p.read_bytes() for p in Path(store.root).rglob("*") if p.is_file()}
    assert checked(store).exit_code == 4
    assert {p: p.read_bytes() for p in Path(store.root).rglob("*") if p.is_file()} == before


# ------------------------------------------------------------------------------------------------------------ damage


@pytest.mark.parametrize("name", ["radiance", "radiance_wide", "normal", "direct", "photon_bounce"])
def test_a_flipped_bit_anywhere_in_a_shard_is_found_and_named(store: Store, scene: SceneStore, name: str) -> None:
    path = shard(scene, name, 1)
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 3).astype(int).tolist():
        flip(path, place)
        report = checked(store)
        assert "checksum" in found(report), place
        (group,) = [g for g in report.scenes[0].groups if g.cause.label == "checksum"]
        assert group.first[0].job == 1
        assert group.first[0].file == f"{scene.name}/plans/000000/{name}/{path.name}"
        path.write_bytes(whole)
    assert found(checked(store)) == {}


@pytest.mark.parametrize(
    ("harm", "cause"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-3]), "size"),
        (lambda path: path.write_bytes(path.read_bytes() + b"more"), "size"),
        (lambda path: path.write_bytes(b""), "size"),
        (lambda path: path.unlink(), "missing-file"),
    ],
    ids=["cut", "grown", "emptied", "removed"],
)
@pytest.mark.parametrize("name", ["radiance", "normal"])
def test_a_file_that_is_not_as_committed_is_found(
    store: Store, scene: SceneStore, name: str, harm: Callable[[Path], object], cause: str
) -> None:
    harm(shard(scene, name))
    assert found(checked(store)) == {cause: 1}


def test_a_whole_file_that_is_not_the_one_committed_is_found(store: Store, scene: SceneStore) -> None:
    """Every checksum in it is right: it is the same array of another commit."""
    other = Store(Path(store.root).with_name("other"), create=True)
    request = Request(modifications=5, views_per_modification=2)
    theirs = other.scene(other.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    given = samples.outputs(theirs, 0)
    for halves in given.radiance.values():
        halves += np.float32(1)
    samples.commit(theirs, 0, given)
    shutil.copyfile(shard(theirs, "radiance"), shard(scene, "radiance"))
    assert found(checked(store)) == {"checksum": 1}


@pytest.mark.parametrize("content", ["", '{"job": 0}', "[1]"])
def test_a_marker_that_is_none_is_found(store: Store, scene: SceneStore, content: str) -> None:
    marker(scene, 0).write_text(content)
    assert found(checked(store)) == {"marker": 1}


def test_a_marker_that_names_files_outside_the_scene_is_found_and_they_are_not_touched(
    store: Store, scene: SceneStore
) -> None:
    document = json.loads(marker(scene, 0).read_text())
    mine = Path(store.root).with_name("mine")
    mine.write_text("mine")
    document["files"]["plans/000000/../../../../../mine"] = {"size": 4, "crc32c": "00000000"}
    marker(scene, 0).write_text(json.dumps(document))
    assert found(checked(store, repair=True)) == {"marker": 1}
    assert mine.read_text() == "mine"
    assert scene.missing_jobs() == [0]


def test_a_marker_of_a_job_that_no_plan_has_is_found_and_set_aside(store: Store, scene: SceneStore) -> None:
    shutil.copyfile(marker(scene, 0), marker(scene, 7))
    assert found(checked(store)) == {"no-plan": 1}
    assert checked(store, repair=True).exit_code == 7
    assert not marker(scene, 7).exists()
    assert found(checked(store)) == {}


def test_a_value_that_is_not_finite_is_found(store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """No writer of ours stores one."""
    monkeypatch.setattr("photonfarm.store.model.commit.scale_to_array", lambda halves, _: ("radiance", halves))
    monkeypatch.setattr("photonfarm.store.model.commit.stays_finite", lambda *_: True)

    def poison(given: Any) -> None:
        given.radiance[1][1, 2, 3, 0] = np.nan
        given.radiance[2][0, 0, 0, 0] = np.inf
        given.buffers[3].depth[0, 0] = -np.inf
        given.guides[3].mean_normal[0, 0, 0] = np.nan

    recommitted(scene, 0, poison)
    assert found(checked(store)) == {"not-finite": 4}


def test_rows_that_are_missing_or_that_the_plan_does_not_use_are_found(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last job has two samples; of another plan, it has three."""
    from photonfarm.store.model.commit import JobWriter

    monkeypatch.setattr(JobWriter, "_claim", lambda self, kind, _: self._missing[kind].clear())

    def misplace(given: Any) -> None:
        given.radiance[10] = given.radiance.pop(9) + np.float32(1)
        del given.buffers[8]

    recommitted(scene, 2, misplace)
    assert found(checked(store)) == {"unused-row": 1, "missing-row": 1 + 17}


def test_a_bad_sector_is_a_finding_like_others_and_its_job_is_set_aside(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Row 5 of the scene, which is row 1 of the shard."""
    path, preadv = shard(scene, "radiance", 1), os.preadv
    bad, rows = path.stat().st_ino, range(760, 780)

    def failing(descriptor: int, memory: Any, offset: int, *flags: int) -> int:
        if os.fstat(descriptor).st_ino == bad and offset in rows and len(memory) > 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return preadv(descriptor, memory, offset, *flags)

    monkeypatch.setattr(os, "preadv", failing)
    report = checked(store, repair=True)
    assert found(report) == {"checksum": 1}
    assert (report.exit_code, report.scenes[0].set_aside) == (7, ("job 1",))
    (group,) = report.scenes[0].groups
    assert group.first[0].row == 6


def test_a_marker_that_cannot_be_read_is_told_and_the_rest_is_checked_and_repaired(
    store: Store, scene: SceneStore
) -> None:
    marker(scene, 0).rename(marker(scene, 0).with_suffix(".kept"))
    marker(scene, 0).mkdir()
    flip(shard(scene, "depth", 1), 20)
    report = checked(store, repair=True)
    assert found(report) == {"unreadable": 1, "checksum": 1}
    assert (report.exit_code, report.scenes[0].set_aside) == (4, ("job 1",))


@pytest.mark.parametrize("name", ["plans/000000/view", "base/cloud/normal"])
def test_inputs_and_base_that_cannot_be_read_are_told_and_the_rest_is_checked(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """They may be whole, in a bucket that did not answer, say; so nothing is set aside for it."""
    plain = schema.read_input

    def failing(storage: Any, folder: str, array: Any) -> Any:
        if folder.endswith(name):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return plain(storage, folder, array)

    monkeypatch.setattr(schema, "read_input", failing)
    report = checked(store, repair=True)
    assert (found(report), report.scenes[0].samples, report.scenes[0].set_aside) == ({"unreadable": 1}, 10, ())


def test_a_store_that_cannot_be_reached_ends_the_check(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that fails would otherwise be a finding of each job."""

    def failing(*_: Any) -> Any:
        raise OSError(errno.EIO, "no answer")

    read = job_check._JobCheck.run

    def unplugged(self: Any) -> Any:
        monkeypatch.setattr(LocalStorage, "read", failing)
        monkeypatch.setattr(LocalStorage, "names", failing)
        return read(self)

    monkeypatch.setattr(job_check._JobCheck, "run", unplugged)
    with pytest.raises(StoreError):
        checked(store)


# ------------------------------------------------------------------------------------- files that belong to no job


def test_data_without_a_marker_and_foreign_files_are_noted_and_left_alone(store: Store, scene: SceneStore) -> None:
    marker(scene, 1).unlink()
    (scene.folder / "committed/notes.json").write_text("{}")
    (scene.folder / "plans/000000/depth/c.9.0.0").write_text("?")
    scene.storage.part().write_bytes(b"half a file")
    report = checked(store, repair=True)
    assert (report.exit_code, report.parts, report.quarantine) == (0, 1, None)
    assert noted(report) == {"no-marker": 1, "foreign-file": 2}
    assert shard(scene, "depth", 1).exists()


@pytest.mark.parametrize(
    "chunk",
    ["plans/000000/sample_pass/c.0", "plans/000000/view/c.0.0", "base/cloud/face/c.0", "base/geometry/faces/c.0.0"],
)
def test_a_missing_chunk_is_never_read_as_fill_values(store: Store, scene: SceneStore, chunk: str) -> None:
    (scene.folder / chunk).unlink()
    reader = SceneReader(store.root, scene.scene_id)
    with pytest.raises(CorruptError, match=re.escape(chunk)):
        reader.base() if chunk.startswith("base") else reader.refresh()


# ----------------------------------------------------------------------------------------------------- command line


def run(*arguments: str) -> Any:
    return CliRunner().invoke(umbrella, ["store", "check", *arguments], prog_name="photonfarm")


def test_the_command_tells_findings_by_cause_and_exits_with_their_code(store: Store, scene: SceneStore) -> None:
    assert run("--store", str(store.root)).exit_code == 0
    for row in range(4):
        flip(shard(scene, "radiance"), row * 800 + 20)
    flip(shard(scene, "albedo"), 20)
    told = run("--store", str(store.root))
    assert told.exit_code == 4
    assert "checksum: " in told.stdout
    assert "--repair" in told.stdout
    printed = json.loads(run("--store", str(store.root), "--json", "--scene", "small").stdout)
    (about,) = printed["scenes"]
    (group,) = [group for group in about["groups"] if group["cause"] == "checksum"]
    assert (printed["exit_code"], group["count"], len(group["first"])) == (4, 5, 5)
    assert run("--store", str(store.root), "--repair").exit_code == 7
    assert run("--store", str(store.root)).exit_code == 0


def test_a_scene_that_is_not_there_is_an_error_that_names_those_that_are(store: Store, scene: SceneStore) -> None:
    told = run("--store", str(store.root), "--scene", "none")
    assert scene.scene_id in str(told.exception)
    assert scene.missing_jobs() == []
