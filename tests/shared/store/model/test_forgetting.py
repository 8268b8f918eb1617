"""`store forget`: the scene is gone, whoever follows it sees that, and it can be made anew under the same names."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples

from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.plan.request import Request
from photonfarm.store import JobWriter, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.format import markers
from photonfarm.store.model.withdrawal import forget
from photonfarm.store.read import reader as reading

FORGET = """
import os, signal, sys
from photonfarm.store import Store
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.model.withdrawal import forget
left = int(sys.argv[3])
for name in ("delete", "delete_folder", "adopt"):
    def dying(*args, plain=getattr(LocalStorage, name), **options):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return plain(*args, **options)
    setattr(LocalStorage, name, dying)
forget(Store(sys.argv[1]), sys.argv[2])
"""


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Two scenes, of 4 samples each, in two plans."""
    store = Store(tmp_path / "store", create=True)
    for spec in (samples.small_spec(), samples.small_spec(name="other", points=5)):
        scene = store.scene(store.plan(spec, Request(modifications=2), shard_rows=2).scene_id)
        scene.plan(Request(modifications=4))
        scene.write_base(*samples.base())
        samples.commit_all(scene)
    return store


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return next(scene for scene in store.scenes() if scene.spec.name == "small")


def test_it_is_gone_and_other_scenes_are_not(store: Store, scene: SceneStore) -> None:
    assert forget(Store(store.root), scene.scene_id).jobs == 2
    opened = Store(store.root)
    assert [each.spec.name for each in opened.scenes()] == ["other"]
    assert not opened.has_scene(scene.scene_id)
    assert check_store(opened, when="now").exit_code == 0
    assert samples.reader_of(opened.scenes()[0]).rows.size == 4
    with pytest.raises(StoreError, match=f"holds no scene {scene.scene_id}"):
        forget(opened, scene.scene_id)


def test_who_knew_its_plans_takes_no_others_for_them(store: Store, scene: SceneStore) -> None:
    before = scene.plans()
    forget(Store(store.root), scene.scene_id)
    assert scene.plans() == []
    assert scene.missing_jobs() == []
    other = Request(modifications=3, seed=7)
    assert Store(store.root).plan(scene.spec, other, shard_rows=3).scene_id == scene.scene_id
    (plan,) = scene.plans()
    assert plan.shard_rows == 3
    assert not np.array_equal(plan.rows.modification[:2], before[0].rows.modification)
    assert scene.missing_jobs() == [0]
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    assert samples.reader_of(scene).rows.tolist() == [0, 1, 2]
    assert check_store(Store(store.root), when="now").exit_code == 0


def plan_anew(scene: SceneStore) -> SceneStore:
    """The scene forgotten, and planned again with other content."""
    forget(Store(scene.storage.where), scene.scene_id)
    again = Store(scene.storage.where)
    return again.scene(again.plan(scene.spec, Request(modifications=4, seed=7), shard_rows=2).scene_id)


@pytest.mark.parametrize("when", ["before the commit", "before the marker"])
def test_a_writer_that_slept_through_it_commits_nothing_of_what_it_rendered(
    scene: SceneStore, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    scene.plan(Request(modifications=6))
    given, place = samples.outputs(scene, 2), markers.place_marker

    def late(*about: Any) -> bool:
        monkeypatch.undo()
        plan_anew(scene)
        return place(*about)

    if when == "before the marker":
        monkeypatch.setattr(markers, "place_marker", late)
        assert not samples.commit(scene, 2, given)
        again = Store(scene.storage.where).scene(scene.scene_id)
    else:
        with JobWriter(scene, scene.job_rows(2)) as out:
            samples.give(out, given)
            again = plan_anew(scene)
            assert not out.commit(samples.FIGURES)
    assert again.missing_jobs() == [0, 1]
    again.write_base(*samples.base())
    samples.commit_all(again)
    assert check_store(Store(scene.storage.where), when="now").exit_code == 0


def test_who_read_it_before_reads_nothing_of_what_is_planned_anew(
    scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "REMEMBERED_S", 0.0)
    reader = samples.reader_of(scene)
    reader.read(0)
    again = plan_anew(scene)
    again.write_base(*samples.base())
    samples.commit_all(again)
    for row in range(2, 4):  # of shards that are not open yet
        with pytest.raises(IncompleteError, match="was forgotten"):
            reader.read(row)


@pytest.mark.parametrize("point", range(1, 12))
def test_killed_at_any_point_nothing_half_is_taken_for_a_sample(store: Store, scene: SceneStore, point: int) -> None:
    clean = {row: samples.reader_of(scene).read(row).radiance for row in range(4)}
    command = [sys.executable, "-c", FORGET, str(store.root), scene.scene_id, str(point)]
    killed = subprocess.run(command, timeout=60).returncode
    assert killed in (-signal.SIGKILL, 0)
    opened = Store(store.root)
    if opened.has_scene(scene.scene_id):
        try:
            reader = samples.reader_of(opened.scene(scene.scene_id))
        except StoreError:  # its spec is deleted last
            reader = None
        for row in reader.rows.tolist() if reader else ():
            np.testing.assert_array_equal(reader.read(row).radiance, clean[row])
        forget(opened, scene.scene_id)
    opened = Store(store.root)
    assert not opened.has_scene(scene.scene_id)
    again = opened.scene(opened.plan(scene.spec, Request(modifications=2), shard_rows=2).scene_id)
    again.write_base(*samples.base())
    samples.commit_all(again)
    assert samples.reader_of(again).rows.tolist() == [0, 1]
    assert check_store(opened, when="now").exit_code == 0
