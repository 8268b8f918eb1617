"""A store whose machines have clocks a year apart: nothing is lost, numbered or ordered by what these tell."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from skewed_clock import SKEWS, YEAR_S, Machine, root_of, rows_read

from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.io.storage import FOREIGN_AGE_S, STRAY_AGE_S

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="loads a library before a process's own")


@SKEWS
def test_the_clock_of_such_a_machine_is_wrong_for_all_that_ask_it(
    machine: Machine, tmp_path: Path, skew_s: int
) -> None:
    """The other tests show nothing unless this holds."""
    Store(tmp_path / "store", create=True)
    code = """
import time, datetime, os
now = [time.time(), time.time_ns() / 1e9, datetime.datetime.now(datetime.UTC).timestamp()]
path = Path(root) / "stamped"
path.touch()
print(*now, path.stat().st_mtime)
"""
    *told, stamped = map(float, machine(skew_s, tmp_path / "store", code).split())
    assert np.abs(np.array(told) - time.time() - skew_s).max() < 60
    assert abs(stamped - time.time()) < 60


# --------------------------------------------------------------------------------------------------------------- sweeps


@SKEWS
def test_a_sweep_by_a_machine_with_a_wrong_clock_leaves_what_living_writers_need(
    machine: Machine, scene: SceneStore, skew_s: int
) -> None:
    """A job here, in the middle of its rows, and parts of other machines: all fresh, by the file system's clock."""
    given = samples.outputs(scene, 0)
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    folder = mine.with_name("another-machine-1a2b3c4d5e-17-1-0.partial")  # a plan, on its way
    foreign.write_bytes(b"half a file")
    folder.mkdir()
    with scene.job_writer(scene.job_rows(0)) as out:
        for row, photons in given.photons.items():
            out.photons(row, photons)
        for row, buffers in given.buffers.items():
            out.view(row, buffers, given.guides[row], given.visibility[row])
        first, *others = given.radiance
        out.radiance(first, given.radiance[first])
        assert machine(skew_s, root_of(scene), "print(store.sweep(), store.sweep(stray_age_s=0))") == "0 0"
        for row in others:
            out.radiance(row, given.radiance[row])
        assert out.commit(samples.FIGURES)
    assert foreign.exists()
    assert folder.exists()
    assert len(rows_read(scene)) == 2


@SKEWS
def test_a_sweep_by_a_machine_with_a_wrong_clock_takes_what_is_old_by_the_file_systems(
    machine: Machine, scene: SceneStore, skew_s: int
) -> None:
    mine = scene.storage.part()
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))  # no process has this number
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    ages = {dead: STRAY_AGE_S, foreign: FOREIGN_AGE_S}
    for path, age_s in ages.items():
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() - age_s + 30))
    assert machine(skew_s, root_of(scene), "print(store.sweep())") == "0"
    for path, age_s in ages.items():
        os.utime(path, (0, time.time() - age_s - 1))
    assert machine(skew_s, root_of(scene), "print(store.sweep())") == "2"


@pytest.mark.parametrize("ahead_s", [1, 3600, YEAR_S])
def test_a_part_whose_stamp_lies_in_the_future_is_left_until_that_is_past(scene: SceneStore, ahead_s: int) -> None:
    """Some file systems let machines stamp their files themselves; a negative age is not taken for a great one."""
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))
    for path in (mine, foreign, dead):
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() + ahead_s + 30))
    assert scene.storage.sweep() == 0
    for path in (mine, foreign, dead):
        os.utime(path, (0, time.time() - STRAY_AGE_S - 1))
    assert scene.storage.sweep() == 1
    assert not dead.exists()


@pytest.mark.parametrize("hours", [1, 12, 23])
def test_a_part_stamped_by_a_machine_that_is_hours_behind_is_left_to_its_writer(scene: SceneStore, hours: int) -> None:
    """This holds up to a day, the documented age: clocks of one farm differ by less, or its stamps are the server's."""
    given = samples.outputs(scene, 0)
    with scene.job_writer(scene.job_rows(0)) as out:
        samples.give(out, given)
        foreign = scene.storage.part().with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
        foreign.write_bytes(b"half a file")
        for path in (root_of(scene) / "tmp").iterdir():
            os.utime(path, (0, time.time() - hours * 3600))
        assert Store(root_of(scene)).sweep(stray_age_s=0) == 0
        assert foreign.exists()
        assert out.commit(samples.FIGURES)


# ---------------------------------------------------------------------------------------------- commits, plans, repairs

RENDER = """
store.scenes()[0]
renderer = ShardRenderer(store, worker="elsewhere", load=analytic.AnalyticScene.load)
print(*[renderer.render(store.scene_ids()[0], job) for job in {jobs}])
"""


def test_jobs_of_machines_a_year_apart_are_all_committed_once_and_are_what_one_machine_renders(
    machine: Machine,
    scene: SceneStore,
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
) -> None:
    root = root_of(scene)
    reader = SceneReader(root, scene.scene_id)
    assert machine(YEAR_S, root, RENDER.format(jobs=[0, 2])) == "True True"
    assert reader.refresh().size == 4
    assert machine(-YEAR_S, root, RENDER.format(jobs=[2, 1, 0])) == "False True False"
    assert reader.refresh().size == 2
    assert machine(0, root, RENDER.format(jobs=[1, 3])) == "False True"
    assert reader.refresh().size == 2
    assert stored_bytes(scene) == clean_bytes(4)
    assert check_store(Store(root), when="now").exit_code == 0


def test_what_is_committed_is_the_same_whatever_the_stamps_of_its_files_are(scene: SceneStore) -> None:
    """A marker older than its files, or than its plan, and all of them older or younger than now."""
    samples.commit_all(scene)
    scene.write_base(*_base(scene))
    before = rows_read(scene)
    files = [path for path in root_of(scene).rglob("*") if path.is_file()]
    for i, order in enumerate([files, list(reversed(files))]):
        for n, path in enumerate(order):
            os.utime(path, (0, time.time() + (n - len(files) / 2) * 86400 * (i + 1)))
        assert Store(root_of(scene)).scene(scene.scene_id).missing_jobs() == []
        assert rows_read(scene) == before
        assert check_store(Store(root_of(scene)), when="now", repair=True).exit_code == 0
        assert Store(root_of(scene)).sweep() == 0


def _base(scene: SceneStore) -> Any:
    geometry, cloud = samples.base()
    return geometry, type(cloud)(**{f: np.resize(getattr(cloud, f), _shape(cloud, f, scene)) for f in cloud.__slots__})


def _shape(cloud: Any, name: str, scene: SceneStore) -> tuple[int, ...]:
    return (scene.spec.points, *getattr(cloud, name).shape[1:])


def test_plans_of_machines_a_year_apart_are_numbered_in_their_order_and_plan_nothing_twice(
    machine: Machine, scene: SceneStore
) -> None:
    root = root_of(scene)
    code = "asked = Request(modifications={n}, views_per_modification=2, passes=2)\n"
    code += "done = store.plan(analytic.small_spec(), asked)\nprint(done.plan, done.new, done.known)"
    told = [machine(skew_s, root, code.format(n=n)) for n, skew_s in [(4, YEAR_S), (6, -YEAR_S), (5, YEAR_S), (7, 0)]]
    assert told == ["1 8 8", "2 8 16", "None 0 20", "3 4 24"]
    top_up = "print(store.scenes()[0].plan(TopUp.of('+1', ['views=first:1'])).plan)"
    assert [machine(skew_s, root, top_up) for skew_s in (-YEAR_S, YEAR_S)] == ["4", "5"]
    plans = Store(root).scene(scene.scene_id).plans()
    assert [plan.number for plan in plans] == list(range(6))
    assert [plan.first_job for plan in plans[1:]] == [plan.end_job for plan in plans[:-1]]
    keys = np.concatenate([plan.rows.sample_key[plan.rows.sample_pass >= 0] for plan in plans])
    assert len(np.unique(keys, axis=0)) == len(keys) == 28 + 2


def test_repairs_of_machines_a_year_apart_are_numbered_in_their_order_and_lose_nothing(
    machine: Machine, scene: SceneStore
) -> None:
    root = root_of(scene)
    machine(0, root, RENDER.format(jobs=[0, 1, 2, 3]))
    repair = "print(check_store(store, when='then', repair=True).quarantine)"
    for number, (skew_s, job) in enumerate([(YEAR_S, 1), (-YEAR_S, 1), (0, 2)]):
        file = scene.folder / next(name for name in scene.marker(job)["files"] if "depth" in name)
        content = b"x" + file.read_bytes()[1:]
        file.write_bytes(content)
        assert machine(skew_s, root, repair) == f"quarantine/{number:06d}"
        assert (root / f"quarantine/{number:06d}" / file.relative_to(root)).read_bytes() == content
        assert machine(-skew_s, root, RENDER.format(jobs=[job])) == "True"
    assert len(rows_read(scene)) == 8
