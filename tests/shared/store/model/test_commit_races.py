"""A commit among others that change the job's files meanwhile: what is announced is what is there."""

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import pytest
import store_samples as samples

from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.format import markers
from photonfarm.store.io import local
from photonfarm.store.model.commit import JobWriter


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """A committed job of 4 samples, and the base."""
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=4), shard_rows=4).scene_id)
    samples.commit_all(scene)
    scene.write_base(*samples.base())
    return scene


def whole(scene: SceneStore) -> None:
    """The job is committed, and its marker tells what is there."""
    assert scene.missing_jobs() == []
    root = scene.storage.root
    (report,) = check_store(Store(root), when="now").scenes
    assert [g for g in report.groups if g.cause.remedy.name != "LOOK" and g.cause.label != "equal-samples"] == []


def before(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, work: Callable[[], None]) -> None:
    """Do some work before the first call of a function."""
    plain, left = getattr(owner, name), iter([work])

    def changed(*args: Any, **kwargs: Any) -> Any:
        for each in left:
            each()
        return plain(*args, **kwargs)

    monkeypatch.setattr(owner, name, changed)


@pytest.mark.parametrize("theirs", ["before", "after"])
def test_two_writers_of_which_one_replaces_what_the_other_kept_announce_what_is_there(
    scene: SceneStore, monkeypatch: pytest.MonkeyPatch, theirs: str
) -> None:
    """One finds a file damaged, and the other commits, with other values, before that is replaced, or after."""
    (scene.storage.root / markers.marker_name(scene.name, 0)).unlink()
    damaged = next((scene.folder / "plans/000000/radiance").glob("c.0.*"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    ours = samples.outputs(scene, 0)
    other = replace(ours, radiance={row: values + 1 for row, values in ours.radiance.items()})
    another = Store(scene.storage.root).scene(scene.scene_id)
    adopt, left = scene.storage.adopt, iter([None])

    def meanwhile(part: Path, name: str, *, replace: bool = False) -> bool:
        for _ in left if replace and theirs == "before" else ():
            assert samples.commit(another, 0, other)
        return adopt(part, name, replace=replace)

    monkeypatch.setattr(scene.storage, "adopt", meanwhile)
    if theirs == "after":
        before(monkeypatch, markers, "place_marker", lambda: samples.commit(another, 0, other))
    samples.commit(scene, 0, ours, clock=lambda: datetime(2031, 1, 1, tzinfo=UTC))
    told = [json.loads(path.read_text())["when"] for path in scene.storage.root.glob("quarantine/*/job-*.json")]
    assert told == (["2031-01-01T00:00:00+00:00"] if theirs == "before" else [])  # of the other's marker, wrong now
    whole(scene)
    reader = SceneReader(scene.storage.root, scene.scene_id)
    for row in reader.refresh().tolist():
        np.testing.assert_array_equal(reader.read(row).radiance, ours.radiance[row])


@pytest.fixture
def another(scene: SceneStore) -> SceneStore:
    """The scene as another worker sees it, with a job 1 that is planned and not committed."""
    scene.plan(Request(modifications=8))
    return Store(scene.storage.root).scene(scene.scene_id)


def values_of(scene: SceneStore) -> dict[int, np.ndarray]:
    reader = SceneReader(scene.storage.root, scene.scene_id)
    return {row: reader.read(row).radiance for row in reader.refresh().tolist()}


def test_a_writer_whose_files_are_all_its_own_compares_them_with_a_marker_that_came_first(
    scene: SceneStore, another: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def meanwhile() -> None:
        """Place the marker of another writer, whose files are not there."""
        rows = next(plan for plan in another.plans() if plan.number == 1)
        file = f"{rows.folder}/depth/c.0.0.0"
        about = {"size": 1, "crc32c": "00000000"}
        named = {file.removeprefix(f"{another.name}/"): about}
        assert markers.place_marker(another.storage, another.name, 1, named, samples.FIGURES)

    before(monkeypatch, markers, "place_marker", meanwhile)
    assert samples.commit(scene, 1, samples.outputs(scene, 1))
    whole(scene)


def test_a_late_writer_that_has_a_file_more_takes_nothing_back(
    scene: SceneStore, another: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its render overflows float16 in one row, and the other's does not; it has looked before that was committed."""
    ours, theirs = samples.outputs(scene, 1), samples.outputs(scene, 1)
    ours.radiance[5][0, 0, 0, 0] = 1e9
    before(monkeypatch, JobWriter, "_adopt_all", lambda: samples.commit(another, 1, theirs))
    assert not samples.commit(scene, 1, ours)
    assert not (scene.storage.root / "quarantine").exists()
    whole(scene)
    for row, halves in theirs.radiance.items():
        np.testing.assert_array_equal(values_of(scene)[row], halves)


def test_a_late_writer_whose_file_would_be_read_first_announces_it(
    scene: SceneStore, another: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The committed job has radiance_wide alone; readers take the rows from radiance, where they find it."""
    ours, theirs = samples.outputs(scene, 1), samples.outputs(scene, 1)
    for halves in theirs.radiance.values():
        halves[0, 0, 0, 0] = 1e9
    before(monkeypatch, JobWriter, "_adopt_all", lambda: samples.commit(another, 1, theirs))
    assert samples.commit(scene, 1, ours)
    assert {Path(name).parent.name for name in scene.marker(1)["files"]} >= {"radiance", "radiance_wide"}
    for row, halves in ours.radiance.items():
        np.testing.assert_array_equal(values_of(scene)[row], halves)


def test_files_of_a_job_are_made_durable_together(
    scene: SceneStore, another: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each waits for the disk: so two are under way at once, or the barrier breaks."""
    both, first, sync = Barrier(2), iter(range(2)), local.sync
    met: list[int] = []

    def meet(path: Path, **how: bool) -> None:
        if how and next(first, None) is not None:
            met.append(both.wait(10))
        sync(path, **how)

    monkeypatch.setattr(local, "sync", meet)
    assert samples.commit(another, 1, samples.outputs(scene, 1))
    assert sorted(met) == [0, 1]
    whole(scene)
