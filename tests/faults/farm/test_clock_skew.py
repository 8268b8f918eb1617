"""A farm whose machines have clocks a year apart: nothing is lost, numbered or ordered by what these tell."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import queue_samples
import store_samples as samples
from skewed_clock import SKEWS, YEAR_S, Machine, root_of, rows_read

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue import WorkerReport, connect, queue_status, read_workers, reconcile
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
def test_a_sweep_by_a_machine_with_a_wrong_clock_takes_what_is_old_by_the_file_systems(
    machine: Machine, scene: SceneStore, skew_s: int
) -> None:
    """And leaves a job here, in the middle of its rows, and fresh parts of other machines."""
    given, mine = samples.outputs(scene, 0), scene.storage.part()
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))  # no process has this number
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    folder = mine.with_name("another-machine-1a2b3c4d5e-17-1-0.partial")  # a plan, on its way
    folder.mkdir()
    ages = {dead: STRAY_AGE_S, foreign: FOREIGN_AGE_S}
    for path, age_s in ages.items():
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() - age_s + 30))
    with scene.job_writer(scene.job_rows(0)) as out:
        samples.give(out, given)
        assert machine(skew_s, root_of(scene), "print(store.sweep())") == "0"
        for path, age_s in ages.items():
            os.utime(path, (0, time.time() - age_s - 1))
        assert machine(skew_s, root_of(scene), "print(store.sweep())") == "2"
        assert out.commit(samples.FIGURES)
    assert folder.exists()
    assert len(rows_read(scene)) == 2


def test_a_part_whose_stamp_lies_in_the_future_is_left_until_that_is_past(scene: SceneStore) -> None:
    """Some file systems let machines stamp their files themselves; a negative age is not taken for a great one."""
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1a2b3c4d5e-17-0-0.partial")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))
    for path in (mine, foreign, dead):
        path.write_bytes(b"half a file")
        os.utime(path, (0, time.time() + YEAR_S))
    assert scene.storage.sweep() == 0
    for path in (mine, foreign, dead):
        os.utime(path, (0, time.time() - STRAY_AGE_S - 1))
    assert scene.storage.sweep() == 1
    assert not dead.exists()


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


# ----------------------------------------------------------------------------------------------------------- the queue


@SKEWS
def test_a_heartbeat_ends_by_the_servers_clock(
    machine: Machine, scene: SceneStore, redis_server: EmbeddedRedis, skew_s: int
) -> None:
    connection = connect(redis_server.url)
    assert reconcile(Store(root_of(scene)), connection) == 4
    code = "told(connect(url), 'ada', WorkerReport(), ttl_s={ttl_s}); taken(connect(url), 'ada', ttl_s={ttl_s})"
    machine(skew_s, root_of(scene), code.format(ttl_s=60), redis_server.url)
    assert list(read_workers(connection)) == ["ada"]
    (execution,) = connection.keys("rq:execution:*")
    assert all(30_000 < connection.pttl(key) <= 60_000 for key in (execution, "rq:worker:ada"))
    assert queue_status(connection).running == 1
    machine(skew_s, root_of(scene), code.format(ttl_s=1), redis_server.url)
    connection.delete(execution)
    time.sleep(1.1)
    assert read_workers(connection) == {}
    assert queue_status(connection).running == 0
    assert machine(skew_s, root_of(scene), "print(reconcile(store, connect(url)))", redis_server.url) == "0"
    assert queue_status(connection).queued == 4, "both jobs are in the queue again"


@SKEWS
def test_who_is_alive_here_is_alive_for_a_machine_with_a_wrong_clock_and_who_is_dead_is_dead(
    machine: Machine, scene: SceneStore, redis_server: EmbeddedRedis, skew_s: int
) -> None:
    """Its reconciliation queues again what nobody renders, and nothing else."""
    connection, url = connect(redis_server.url), redis_server.url
    assert reconcile(Store(root_of(scene)), connection) == 4
    queued = machine(skew_s, root_of(scene), "print(reconcile(store, connect(url)))", url)
    assert queued == "0"
    connection.flushall()
    reconcile(Store(root_of(scene)), connection)
    for worker, ttl_s in (("ada", 60), ("bob", 1)):
        queue_samples.told(connection, worker, WorkerReport(), ttl_s=ttl_s)
        queue_samples.taken(connection, worker, ttl_s=ttl_s)
    time.sleep(1.1)
    assert machine(skew_s, root_of(scene), "print(reconcile(store, connect(url)))", url) == "0"
    assert (queue_status(connection).queued, queue_status(connection).running) == (3, 1)
    told = machine(skew_s, root_of(scene), "print(queue_status(connect(url)).workers)", url)
    assert told == "1"
