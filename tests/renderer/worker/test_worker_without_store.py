"""Workers whose store is another one, goes away or is not there yet."""

import re
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.core.errors import StoreError
from photonfarm.core.processes import process_space
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.job import job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.queue.workers import OtherStoreError, read_workers
from photonfarm.renderer.worker.worker import check, run_worker
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(analytic: ModuleType, tmp_path: Path) -> SceneStore:
    """Two jobs of three samples."""
    store = Store(tmp_path / "store", create=True)
    return store.scene(store.plan(analytic.small_spec(), Request(modifications=6), shard_rows=3).scene_id)


QUICK = {"until_complete": True, "idle_s": 1, "heartbeat_ttl_s": 2.0, "reserve_bytes": 0}


def test_a_worker_for_another_store_is_refused_and_the_queue_keeps_its_jobs(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    connection, store = connect(redis_server.url), Store(tmp_path / "store")
    reconcile(store, connection)
    Store(tmp_path / "typo", create=True)
    with pytest.raises(OtherStoreError):
        run_worker(tmp_path / "typo", redis_server.url, child=analytic.command(), **QUICK)
    assert queue_status(connection).queued == 2
    assert queue_status(connection).workers == 0


SLOWLY = [pytest.param(each, marks=pytest.mark.slow) for each in ("nothing", "another store")]


@pytest.mark.parametrize("in_its_place", ["an empty folder", *SLOWLY])
def test_a_store_that_vanishes_under_a_worker_ends_it_and_the_queue_keeps_its_jobs(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path, in_its_place: str
) -> None:
    root, connection = tmp_path / "store", connect(redis_server.url)
    reconcile(Store(root), connection)
    code = f"""
import runpy, sys
from pathlib import Path
from photonfarm.renderer.jobs import render as jobs
from photonfarm.store import Store
plain = jobs.ShardRenderer.render
def render(self, *job):
    root = Path({str(root)!r})
    root.rename(root.with_name("away"))
    if {in_its_place!r} == "an empty folder":
        root.mkdir()
    if {in_its_place!r} == "another store":
        Store(root, create=True)
    return plain(self, *job)
jobs.ShardRenderer.render = render
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    with pytest.raises(StoreError):
        run_worker(root, redis_server.url, child=(sys.executable, "-c", code, *analytic.command()[1:]), **QUICK)
    assert queue_status(connection).failed == {}
    assert sorted(open_queue(connection).job_ids) == [job_name(scene.scene_id, job) for job in range(2)]


def test_a_store_that_is_not_there_is_not_made(
    analytic: ModuleType, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    with pytest.raises(StoreError, match="photonfarm submit"):
        run_worker(tmp_path / "typo", redis_server.url, child=analytic.command(), **QUICK)
    assert not (tmp_path / "typo").exists()


def test_a_store_is_waited_for_while_the_worker_counts_as_alive(
    analytic: ModuleType, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    log, connection = tmp_path / "log", connect(redis_server.url)
    how = {"name": "ada", "heartbeat_ttl_s": 1.5}
    with analytic.start_worker(tmp_path / "later", redis_server.url, analytic.command(), log, **how) as running:
        analytic.wait_for(lambda: read_workers(connection), 60)
        time.sleep(1.6)  # longer than its heartbeat lasts
        check(redis_server.url)
        assert not (tmp_path / "later").exists()
        store = Store(tmp_path / "later", create=True)
        scene = store.scene(store.plan(analytic.small_spec(), Request(modifications=3), shard_rows=3).scene_id)
        analytic.wait_for(lambda: scene.missing_jobs() == [], 60)
        hosts = {report.host for report in read_workers(connection).values()}
        running.terminate()
        assert running.wait(20) == 0
    assert hosts == {process_space()}
    assert log.read_text().count(f"worker ada: waiting for a store at {tmp_path / 'later'}") == 1
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} ", log.read_text()), "a supervisor tells the time as well"


@pytest.mark.parametrize("times", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_a_worker_ends_when_told_while_its_child_is_talking(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path, times: int
) -> None:
    """Several times, as a signal is only lost if it comes between two things that the child says."""
    code = """
import os, sys, time
sys.stdin.readline()
until = time.monotonic() + 1
while time.monotonic() < until:
    os.write(1, b"x" * 100)
time.sleep(60)
"""
    child, log = (sys.executable, "-c", code), tmp_path / "log"
    for _ in range(times):
        with analytic.start_worker(tmp_path / "store", redis_server.url, child, log) as running:
            analytic.wait_for(lambda: analytic.child_of(running) is not None, 60)
            time.sleep(0.5)
            running.terminate()
            assert running.wait(20) == 0


def test_a_worker_that_waits_for_a_store_ends_when_told(
    analytic: ModuleType, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    with analytic.start_worker(tmp_path / "never", redis_server.url, analytic.command(), log) as running:
        analytic.wait_for(lambda: "waiting for a store" in log.read_text(), 60)
        running.terminate()
        assert running.wait(20) == 0
    assert queue_status(connect(redis_server.url)).workers == 0
