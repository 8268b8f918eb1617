"""`photonfarm store check` finds what is wrong with a store, and `--repair` has it written again, losing nothing."""

import contextlib
import errno
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.shared import cli
from photonfarm.shared.errors import CorruptError, StoreError
from photonfarm.shared.plan import Request
from photonfarm.shared.records import ViewBuffers
from photonfarm.shared.store import SceneReader, SceneStore, Store, repeated_seeds, schema
from photonfarm.shared.store.check import StoreReport, check_store
from photonfarm.shared.store.job_check import JobCheck
from photonfarm.shared.store.local import LocalStorage
from photonfarm.shared.store.quarantine import Quarantine
from photonfarm.shared.top_up import TopUp
from photonfarm.shared.view import Camera

_spec = importlib.util.spec_from_file_location("store_samples", Path(__file__).with_name("store_samples.py"))
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store", create=True)


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Three jobs of 4, 4 and 2 samples, all committed, one of them in radiance_wide; and the base."""
    request = Request(modifications=5, views_per_modification=2)
    scene = store.scene(store.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    commit_all(scene)
    scene.write_base(*samples.base())
    return scene


def outputs(scene: SceneStore, job: int) -> Any:
    given = samples.outputs(scene, job)
    if job == 1:
        given.radiance[5][0, 0, 0, 0] = 1e9
    for row, photons in given.photons.items():
        photons.power[0] += row  # no two modifications alike
    return given


def commit_all(scene: SceneStore) -> None:
    for job in scene.missing_jobs():
        assert samples.commit(scene, job, outputs(scene, job))


def checked(store: Store, **options: Any) -> StoreReport:
    return check_store(Store(store.root), when="now", **options)


def found(report: StoreReport) -> dict[str, int]:
    """How many findings of each cause that is not only worth a look."""
    (scene,) = report.scenes
    return {
        group.cause.label: group.count for group in scene.groups if group.cause.remedy.name != "LOOK"
    }  # fmt: skip


def noted(report: StoreReport) -> dict[str, int]:
    (scene,) = report.scenes
    return {group.cause.label: group.count for group in scene.groups}


def data(scene: SceneStore) -> dict[str, bytes]:
    files = [p for part in ("plans", "base") for p in (scene.folder / part).rglob("*") if p.is_file()]
    return {str(p.relative_to(scene.folder)): p.read_bytes() for p in files}


def shard(scene: SceneStore, name: str, job: int = 0) -> Path:
    (path,) = (scene.folder / "plans/000000" / name).glob(f"c.{job}.*")
    return path


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 0x10
    path.write_bytes(content)


def marker(scene: SceneStore, job: int) -> Path:
    return scene.folder / f"committed/{job:012d}.json"


def recommitted(scene: SceneStore, job: int, change: Callable[[Any], None]) -> None:
    """Commit a job once more with other outputs, as a faulty worker might have."""
    for name in scene.marker(job)["files"]:
        (scene.folder / name).unlink()
    marker(scene, job).unlink()
    given = outputs(scene, job)
    change(given)
    assert samples.commit(scene, job, given)


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


@pytest.mark.parametrize("name", ["radiance", "radiance_wide", "normal", "photon_bounce"])
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
    monkeypatch.setattr("photonfarm.shared.store.commit._radiance", lambda halves, _: ("radiance", halves))
    monkeypatch.setattr("photonfarm.shared.store.commit._stays_finite", lambda *_: True)

    def poison(given: Any) -> None:
        given.radiance[1][1, 2, 3, 0] = np.nan
        given.radiance[2][0, 0, 0, 0] = np.inf
        given.buffers[3].depth[0, 0] = -np.inf

    recommitted(scene, 0, poison)
    assert found(checked(store)) == {"not-finite": 3}


def test_rows_that_are_missing_or_that_the_plan_does_not_use_are_found(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last job has two samples; of another plan, it has three."""
    from photonfarm.shared.store.commit import JobWriter

    monkeypatch.setattr(JobWriter, "_claim", lambda *_: None)
    monkeypatch.setattr(JobWriter, "_check_complete", lambda _: None)

    def misplace(given: Any) -> None:
        given.radiance[10] = given.radiance.pop(9) + np.float32(1)
        del given.buffers[8]

    recommitted(scene, 2, misplace)
    assert found(checked(store)) == {"unused-row": 1, "missing-row": 1 + 3}


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
    assert (group.first[0].detail, group.first[0].row) == ("cannot be read: Input/output error", 6)


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
    """Else a network that fails would be a finding of each job."""

    def failing(*_: Any) -> Any:
        raise OSError(errno.EIO, "no answer")

    read = JobCheck.run

    def unplugged(self: JobCheck, job: int) -> Any:
        monkeypatch.setattr(LocalStorage, "read", failing)
        monkeypatch.setattr(LocalStorage, "names", failing)
        return read(self, job)

    monkeypatch.setattr(JobCheck, "run", unplugged)
    with pytest.raises(StoreError, match="cannot check the store: no answer"):
        checked(store)


# ----------------------------------------------------------------------------------------------------------- content


def test_equal_halves_are_found_and_a_black_or_constant_image_is_no_repeated_seed(
    store: Store, scene: SceneStore
) -> None:
    def change(given: Any) -> None:
        given.radiance[0][1] = given.radiance[0][0]
        given.radiance[1][...] = 0
        given.radiance[2][...] = 0
        given.radiance[3][...] = 0.5

    recommitted(scene, 0, change)
    report = checked(store)
    assert found(report) == {"equal-halves": 1}
    assert noted(report)["black"] == 2


def test_samples_that_share_a_half_are_found_across_jobs(store: Store, scene: SceneStore) -> None:
    def change(given: Any) -> None:
        given.radiance[8][0] = outputs(scene, 0).radiance[2][1]

    recommitted(scene, 2, change)
    report = checked(store)
    assert found(report) == {"equal-samples": 2}
    (group,) = [g for g in report.scenes[0].groups if g.cause.label == "equal-samples"]
    assert {(f.row, f.job) for f in group.first} == {(2, 0), (8, 2)}


def test_samples_whose_keys_give_one_seed_are_noted_and_not_rendered_again(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seeds have 32 bits; rendered again, these samples would come out the same. Here all keys give one."""
    purposes = set()
    monkeypatch.setattr(repeated_seeds, "seed_of", lambda _, purpose: purposes.add(purpose) or 7)

    def change(given: Any) -> None:
        given.radiance[8][0] = outputs(scene, 0).radiance[2][1]

    recommitted(scene, 2, change)
    report = checked(store, repair=True)
    assert (noted(report), report.exit_code, report.scenes[0].set_aside) == ({"same-seed": 2}, 0, ())
    attempts = ("", ", attempt 1", ", attempt 2", ", attempt 3")
    assert purposes == {f"half {half}{attempt}" for half in "AB" for attempt in attempts}


def many(tmp_path: Path, change: Callable[[np.ndarray], None], samples_: int = 256) -> StoreReport:
    """The check of a store of noisy samples; heavy tails, as light transport has them."""
    store = Store(tmp_path / "many", create=True)
    scene = store.scene(store.plan(samples.small_spec(photons={"paths": 0}), Request(modifications=samples_)).scene_id)
    for job in scene.missing_jobs():
        given = samples.outputs(scene, job)
        for row, halves in given.radiance.items():
            halves[...] = np.random.default_rng(row).pareto(2.0, halves.shape)
            change(halves)
        samples.commit(scene, job, given)
    scene.write_base(*samples.base())
    return checked(store)


def test_halves_of_heavy_tailed_noise_do_not_differ(tmp_path: Path) -> None:
    assert found(many(tmp_path, lambda _: None)) == {}


def test_a_half_that_is_biased_somewhere_is_found(tmp_path: Path) -> None:
    """B is a third too dark in one eighth of the image."""

    def darken(halves: np.ndarray) -> None:
        halves[1, 2:3] *= 2 / 3

    report = many(tmp_path, darken)
    assert found(report) == {"halves-differ": 1}
    assert report.exit_code == 4
    assert report.scenes[0].halves.statistic > report.scenes[0].halves.limit


def test_views_of_nothing_and_views_from_behind_are_noted_and_are_no_error(store: Store, scene: SceneStore) -> None:
    """Normals along the rays are seen from behind; against them, from the front."""

    def change(given: Any) -> None:
        size = (scene.spec.film.height, scene.spec.film.width)
        rays = {row: Camera.of(view, scene.spec).rays() for row, view in scene.job_rows(0).views.items()}
        given.buffers[0] = ViewBuffers(*(np.zeros((*size, *c), np.float32) for c in ((), (3,), (3,))))
        given.buffers[1] = ViewBuffers(np.ones(size, np.float32), rays[1], rays[1])
        given.buffers[2] = ViewBuffers(np.ones(size, np.float32), rays[2], -rays[2])
        given.buffers[3] = ViewBuffers(np.ones(size, np.float32), rays[3], -rays[3])

    recommitted(scene, 0, change)
    for job in (1, 2):
        marker(scene, job).unlink()
    report = checked(store)
    assert report.exit_code == 0
    assert {name: count for name, count in noted(report).items() if name != "no-marker"} == {
        "empty-view": 1, "back-facing": 1,
    }  # fmt: skip
    assert report.scenes[0].back_facing_share == pytest.approx(1 / 3)


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


# --------------------------------------------------------------------------------------------------- plans and base


@pytest.mark.parametrize("name", ["view", "sample_modification", "sample_key"])
@pytest.mark.parametrize("gone", [False, True], ids=["flipped", "missing"])
def test_damaged_inputs_of_a_plan_are_found_and_what_is_rendered_is_checked_all_the_same(
    store: Store, scene: SceneStore, name: str, gone: bool
) -> None:
    (path,) = (scene.folder / "plans/000000" / name).glob("c.0*")
    path.unlink() if gone else flip(path, path.stat().st_size - 1)
    flip(shard(scene, "depth", 1), 20)
    report = checked(store, repair=True)
    assert found(report) == {"plan-inputs": 1, "checksum": 1}
    assert report.exit_code == 7
    assert report.scenes[0].samples == 10
    assert not marker(scene, 1).exists()
    assert not shard_or_none(scene, "depth", 1)


def shard_or_none(scene: SceneStore, name: str, job: int) -> list[Path]:
    return list((scene.folder / "plans/000000" / name).glob(f"c.{job}.*"))


def test_a_plan_whose_keys_are_not_those_of_its_content_is_found(store: Store, scene: SceneStore) -> None:
    """Whole by every checksum: another scene's plan."""
    other = Store(Path(store.root).with_name("other"), create=True)
    request = Request(modifications=5, views_per_modification=2, seed=1)
    theirs = other.scene(other.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    for name in ("view", "sample_key"):
        shutil.rmtree(scene.folder / "plans/000000" / name)
        shutil.copytree(theirs.folder / "plans/000000" / name, scene.folder / "plans/000000" / name)
    assert found(checked(store)) == {"plan": 1}


def test_a_plan_that_is_missing_among_others_is_found(store: Store, scene: SceneStore) -> None:
    scene.plan(Request(modifications=6, views_per_modification=2))
    (scene.folder / "plans/000000").rename(Path(store.root).with_name("gone"))
    assert "plan" in found(checked(store))


@pytest.mark.parametrize("gone", ["000000", "000001", "000002"])
@pytest.mark.parametrize("what", ["folder", "zarr.json"])
def test_a_plan_that_is_lost_is_told_and_none_of_its_jobs_is_set_aside(
    store: Store, scene: SceneStore, gone: str, what: str
) -> None:
    """Without it they cannot be rendered again; and once it is put back, nothing is wrong."""
    for n in (6, 7):
        scene.plan(Request(modifications=n, views_per_modification=2))
    commit_all(scene)
    path, aside = scene.folder / "plans" / gone, Path(store.root).with_name("aside")
    path = path if what == "folder" else path / "zarr.json"
    path.rename(aside)
    report = checked(store, repair=True)
    assert (found(report), report.scenes[0].set_aside) == ({"plan": 1}, ())
    (group,) = report.scenes[0].groups
    assert group.first[0].file == f"{scene.name}/plans/{gone}/zarr.json"
    assert "the plan is missing" in group.first[0].detail
    aside.rename(path)
    assert noted(checked(store)) == {}


def test_a_plan_that_is_claimed_and_not_written_yet_is_no_finding(store: Store, scene: SceneStore) -> None:
    (scene.folder / "plans/000001/view").mkdir(parents=True)
    (scene.folder / "plans/000001.claim").write_bytes(b"")
    assert noted(checked(store)) == {}


@pytest.mark.parametrize("harm", ["flip", "chunk", "marker", "index", "removed"])
def test_a_damaged_base_is_set_aside_and_the_next_job_writes_it(store: Store, scene: SceneStore, harm: str) -> None:
    clean = data(scene)
    file = scene.folder / "base/cloud/position/c.0.0"
    if harm == "flip":
        flip(file, 20)
    elif harm == "chunk":
        file.unlink()
    elif harm == "marker":
        (scene.folder / "base/zarr.json").unlink()
    elif harm == "removed":
        shutil.rmtree(scene.folder / "base")
    else:
        geometry, cloud = samples.base()
        shutil.rmtree(scene.folder / "base")
        scene.write_base(replace(geometry, faces=geometry.faces + 1), cloud)
    assert found(checked(store)) == {"base": 1}
    report = checked(store, repair=True)
    assert report.exit_code == 7
    assert scene.missing_jobs() == [2]  # whole, but no other job is left to write the base
    assert report.scenes[0].set_aside == ("base", "job 2 (whole; rendered again, as a job writes the base)")
    commit_all(scene)
    scene.write_base(*samples.base())
    assert data(scene) == clean
    assert found(checked(store)) == {}


def test_a_damaged_spec_is_set_aside_and_the_next_submission_writes_it(store: Store, scene: SceneStore) -> None:
    clean = data(scene)
    file = scene.folder / "spec.json"
    whole = file.read_bytes()
    flip(file, 30)
    assert checked(store, repair=True).exit_code == 7
    assert Store(store.root).scene_ids() == []
    assert checked(store).exit_code == 4  # its plans are there without it
    Store(store.root).plan(samples.small_spec(), Request(modifications=5, views_per_modification=2))
    assert file.read_bytes() == whole
    assert (found(checked(store)), data(scene)) == ({}, clean)


def test_a_marker_may_name_arrays_of_a_later_program(store: Store, scene: SceneStore) -> None:
    about = json.loads(marker(scene, 0).read_text())
    about["files"]["plans/000000/motion/c.0.0"] = {"size": 1, "crc32c": "00000000"}
    marker(scene, 0).write_text(json.dumps(about))
    assert found(checked(store)) == {}


@pytest.mark.parametrize(
    "chunk",
    ["plans/000000/sample_pass/c.0", "plans/000000/view/c.0.0", "base/cloud/face/c.0", "base/geometry/faces/c.0.0"],
)
def test_a_missing_chunk_is_never_read_as_fill_values(store: Store, scene: SceneStore, chunk: str) -> None:
    (scene.folder / chunk).unlink()
    reader = SceneReader(store.root, scene.scene_id)
    with pytest.raises(CorruptError, match=re.escape(f"{chunk}: is missing")):
        reader.base() if chunk.startswith("base") else reader.refresh()


# ---------------------------------------------------------------------------------------------------- plans, repaired

INPUTS = ("modification", "view", "sample_modification", "sample_view", "sample_pass", "sample_key")


@pytest.fixture
def planned_thrice(store: Store, scene: SceneStore) -> SceneStore:
    """A plan, one that adds to it, and a top-up."""
    scene.plan(Request(modifications=7, views_per_modification=3))
    scene.plan(TopUp.of("+40", ["views=first:4"]))
    commit_all(scene)
    return scene


@pytest.mark.parametrize(
    ("name", "gone", "number"),
    [
        *((name, number == 1, number) for number, name in enumerate(INPUTS[:3])),
        *((name, number != 1, number) for number, name in enumerate(INPUTS[3:])),
        ("view/zarr.json", False, 0),
        ("sample_key/zarr.json", True, 1),
        ("depth/zarr.json", False, 2),
    ],
)
def test_a_damaged_file_of_a_plan_is_written_again_from_the_request(
    store: Store, planned_thrice: SceneStore, name: str, gone: bool, number: int
) -> None:
    scene, clean = planned_thrice, data(planned_thrice)
    (path,) = (scene.folder / f"plans/{number:06d}").glob(name if "/" in name else f"{name}/c.0*")
    whole = path.read_bytes()
    path.unlink() if gone else path.write_bytes(whole.replace(b'"chunk', b'"chunc') if "/" in name else flipped(whole))
    with contextlib.suppress(CorruptError):
        if SceneReader(store.root, scene.scene_id).refresh().size:
            assert name == "depth/zarr.json"  # which we do not read
    damaged = None if gone else path.read_bytes()
    report = checked(store)
    assert (found(report), report.exit_code) == ({"plan-inputs": 1}, 4)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"plan-inputs": 1}, 7)
    assert report.scenes[0].set_aside == (f"plan {number}, written again from its request",)
    assert data(scene) == clean
    quarantine = Path(store.root) / report.quarantine
    aside = quarantine / path.relative_to(store.root)
    assert (aside.read_bytes() if aside.exists() else None) == damaged
    (record,) = [json.loads(p.read_text()) for p in quarantine.glob("plan-*.json")]
    assert record["why"][0]["cause"] == "plan-inputs"
    assert found(checked(store)) == {}
    assert SceneReader(store.root, scene.scene_id).refresh().size == sum(plan.samples for plan in scene.plans())


def flipped(content: bytes) -> bytes:
    return content[:-1] + bytes([content[-1] ^ 1])


def test_several_damaged_plans_are_written_again_in_their_order(store: Store, planned_thrice: SceneStore) -> None:
    scene, clean = planned_thrice, data(planned_thrice)
    for number in range(3):
        for name in ("view", "sample_view", "sample_pass"):
            (path,) = (scene.folder / f"plans/{number:06d}/{name}").glob("c.0*")
            flip(path, 3)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code, data(scene) == clean) == ({"plan-inputs": 9}, 7, True)
    assert len(report.scenes[0].set_aside) == 3


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda plan: change(plan, seed=1), "its request gives another modification than is there"),
        (lambda plan: change(plan, modifications=40), "its request does not give its 3 jobs"),
        (lambda plan: change(plan, modifications=0), "its zarr.json cannot be read"),
        (lambda plan: flip(plan / "sample_key/c.0.0", 30), "too little of it can be read"),
    ],
)
def test_a_plan_is_not_written_again_where_its_request_may_be_another(
    store: Store, scene: SceneStore, harm: Callable[[Path], None], said: str
) -> None:
    flip(scene.folder / "plans/000000/view/c.0.0", 30)
    harm(scene.folder / "plans/000000")
    before = data(scene)
    report = checked(store, repair=True)
    assert (report.exit_code, report.scenes[0].set_aside, data(scene) == before) == (4, (), True)
    (group,) = [group for group in report.scenes[0].groups if group.cause.label == "plan"]
    assert said in group.first[0].detail
    assert "back from a copy of the store" in group.first[0].detail


def change(plan: Path, **request: int) -> None:
    about = json.loads((plan / "zarr.json").read_text())
    about["attributes"]["request"].update(request)
    (plan / "zarr.json").write_text(json.dumps(about))


# ------------------------------------------------------------------------------------------------------------ repair


def test_repair_sets_damaged_jobs_aside_with_a_record_and_rendering_them_again_gives_the_clean_bytes(
    store: Store, scene: SceneStore
) -> None:
    clean, markers = data(scene), {job: marker(scene, job).read_bytes() for job in range(3)}
    damaged = shard(scene, "depth", 1)
    flip(damaged, 20)
    kept = damaged.read_bytes()
    report = checked(store, repair=True)
    assert report.exit_code == 7
    assert report.scenes[0].set_aside == ("job 1",)
    assert scene.missing_jobs() == [1]
    assert list(scene.folder.rglob("c.1.*")) == []

    quarantine = Path(store.root) / report.quarantine
    (record,) = [json.loads(p.read_text()) for p in quarantine.glob("job-*.json")]
    assert record["why"][0]["cause"] == "checksum"
    assert len(record["moved"]) == len([p for p in (quarantine / "scenes").rglob("*") if p.is_file()])
    assert (quarantine / damaged.relative_to(store.root)).read_bytes() == kept
    assert (quarantine / marker(scene, 1).relative_to(store.root)).read_bytes() == markers[1]

    commit_all(scene)
    assert data(scene) == clean
    assert found(checked(store, repair=True)) == {}


def test_workers_render_again_what_a_repair_has_set_aside_bit_for_bit_and_with_it_the_base(store: Store) -> None:
    from photonfarm.renderer.jobs import ShardRenderer

    file = Path(__file__).parents[1] / "faults/analytic_scene.py"
    loader = importlib.util.spec_from_file_location("analytic_scene", file)
    analytic = importlib.util.module_from_spec(loader)
    loader.loader.exec_module(analytic)
    scene = store.scene(store.plan(analytic.small_spec(), Request(modifications=8), shard_rows=4).scene_id)
    worker = ShardRenderer(store, worker="worker", load=analytic.AnalyticScene.load)
    for job in scene.missing_jobs():
        worker.render(scene.scene_id, job)
    clean = data(scene)
    flip(shard(scene, "radiance", 1), 20)
    flip(next((scene.folder / "base/cloud/normal").glob("c.*")), 20)
    assert checked(store, repair=True).scenes[0].set_aside == ("job 1", "base")
    for job in scene.missing_jobs():
        worker.render(scene.scene_id, job)
    assert (data(scene), found(checked(store))) == (clean, {})


def test_every_repair_has_a_folder_of_its_own_and_nothing_in_it_is_ever_replaced(
    store: Store, scene: SceneStore
) -> None:
    folders = []
    for _ in range(3):
        flip(shard(scene, "depth", 1), 20)
        folders.append(checked(store, repair=True).quarantine)
        commit_all(scene)
    assert folders == ["quarantine/000000", "quarantine/000001", "quarantine/000002"]
    assert all(list((Path(store.root) / folder).rglob("c.1.0.0")) for folder in folders)


def test_a_reader_goes_on_through_a_repair_and_sees_the_samples_come_back(store: Store, scene: SceneStore) -> None:
    reader = SceneReader(store.root, scene.scene_id)
    assert reader.refresh().size == 10
    before = reader.read(4).radiance
    flip(shard(scene, "depth", 1), 20)
    checked(store, repair=True)
    reader.read(0)
    assert reader.refresh().size == 0
    assert reader.rows.tolist() == [0, 1, 2, 3, 8, 9]
    commit_all(scene)
    assert reader.refresh().tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(reader.read(4).radiance, before)


def test_a_job_that_was_rendered_again_since_the_check_is_left_alone(store: Store, scene: SceneStore) -> None:
    seen = marker(scene, 1).read_bytes()
    marker(scene, 1).write_bytes(seen.replace(b'"core_s": 2.0', b'"core_s": 3.0'))
    assert not Quarantine(store.storage, "now").job(scene.name, 1, seen, [], [])
    assert scene.missing_jobs() == []


def test_a_marker_that_a_worker_places_in_the_middle_of_a_repair_is_set_aside_with_its_files(
    store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worker found our files in its way, kept them, and announces them just before they are moved."""
    content, move = marker(scene, 1).read_bytes(), store.storage.move
    places = iter([True])

    def moved(name: str, new_name: str) -> None:
        move(name, new_name)
        if name.endswith("000000000001.json") and next(places, False):
            marker(scene, 1).write_bytes(content)

    monkeypatch.setattr(store.storage, "move", moved)
    files = [f"{scene.name}/{name}" for name in scene.marker(1)["files"]]
    assert Quarantine(store.storage, "now").job(scene.name, 1, content, files, [])
    assert scene.missing_jobs() == [1]
    commit_all(scene)
    assert found(checked(store)) == {}


# A repair of this job places two records by a link each, and renames the marker and nine files.
POINTS = [("link", 1, "before"), ("link", 2, "before"), ("link", 2, "after"), ("fsync", 3, "before")]
POINTS += [("rename", n, when) for n in (1, 2, 5, 10) for when in ("before", "after")]


def killed(function: str, count: int, when: str, work: Callable[[], object]) -> None:
    """Do some work in a process of its own, which is killed at a call of a function of `os`."""
    plain, left = getattr(os, function), iter(range(count - 1, -1, -1))

    def dying(*args: Any, **kwargs: Any) -> Any:
        last = next(left, -1) == 0
        if last and when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = plain(*args, **kwargs)
        if last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    child = os.fork()
    if not child:
        setattr(os, function, dying)
        work()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


@pytest.mark.parametrize("harm", ["flipped", "equal halves"])
@pytest.mark.parametrize("point", POINTS, ids=lambda point: "-".join(map(str, point)))
def test_a_repair_killed_at_any_point_loses_nothing_and_the_next_one_completes_it(
    store: Store, scene: SceneStore, point: tuple[str, int, str], harm: str
) -> None:
    """Whatever was moved, and whichever worker comes in between, the clean bytes are there in the end."""
    clean = data(scene)
    if harm == "flipped":
        flip(shard(scene, "radiance", 0), 20)
    else:
        recommitted(scene, 0, lambda given: given.radiance[1].__setitem__(1, given.radiance[1][0]))
    everything = {p.read_bytes() for p in scene.folder.rglob("*") if p.is_file()}
    files = [f"{scene.name}/{name}" for name in scene.marker(0)["files"]]
    content = marker(scene, 0).read_bytes()
    killed(*point, lambda: Quarantine(store.storage, "then").job(scene.name, 0, content, files, []))

    kept = {p.read_bytes() for p in Path(store.root).rglob("*") if p.is_file()}
    assert everything <= kept
    reader = SceneReader(store.root, scene.scene_id)
    reader.refresh()
    rows = reader.rows.tolist()
    assert rows in ([*range(10)], [*range(4, 10)])  # all of the job's, or none
    if 0 not in rows:
        assert [reader.read(row).row for row in rows] == rows
    commit_all(scene)
    if data(scene) != clean:
        assert checked(store, repair=True).exit_code == 7
        commit_all(scene)
        assert data(scene) == clean


def test_two_repairs_at_once_set_each_job_aside_once(store: Store, scene: SceneStore) -> None:
    clean = data(scene)
    for job in range(3):
        flip(shard(scene, "depth", job), 20)
    code = (
        "import sys; from photonfarm.shared.store import Store; from photonfarm.shared.store.check import check_store\n"
    )
    code += "check_store(Store(sys.argv[1]), when='then', repair=True)"
    both = [subprocess.Popen([sys.executable, "-c", code, str(store.root)]) for _ in range(2)]
    assert [process.wait(60) for process in both] == [0, 0]
    assert scene.missing_jobs() == [0, 1, 2]
    assert len(list(Path(store.root).glob("quarantine/*/scenes/*/committed/*.json"))) == 3
    commit_all(scene)
    assert (data(scene), found(checked(store))) == (clean, {})


# ----------------------------------------------------------------------------------------------------- command line


def run(*arguments: str) -> Any:
    return CliRunner().invoke(cli.umbrella, ["store", "check", *arguments], prog_name="photonfarm")


def test_the_command_tells_findings_by_cause_and_exits_with_their_code(store: Store, scene: SceneStore) -> None:
    assert run("--store", str(store.root)).exit_code == 0
    for row in range(4):
        flip(shard(scene, "radiance"), row * 800 + 20)
    flip(shard(scene, "albedo"), 20)
    told = run("--store", str(store.root))
    assert told.exit_code == 4
    assert "checksum: stored bytes are not what was committed (render again)" in told.stdout
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
