"""Workers and queues whose machines' clocks differ by a year: who is alive is told by the server's clock."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import queue_samples
from skewed_clock import SKEWS, YEAR_S, Machine, root_of, rows_read

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue import WorkerReport, connect, queue_status, read_workers, reconcile
from photonfarm.store import SceneStore, Store

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="loads a library before a process's own")


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


@pytest.fixture
def skewed_worker(
    clock: Path, analytic: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """`analytic_scene.start_worker` with a skew; all of them are ended with the test."""
    started = []

    def start(skew_s: int, *arguments: Any, **settings: Any) -> subprocess.Popen[bytes]:
        with monkeypatch.context() as changed:
            changed.setenv("LD_PRELOAD", str(clock))
            changed.setenv("CLOCK_SKEW_S", str(skew_s))
            started.append(analytic.start_worker(*arguments, **settings))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_workers_a_year_apart_share_a_queue_and_one_that_dies_is_replaced(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    skewed_worker: Callable[..., subprocess.Popen[bytes]],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
    redis_server: EmbeddedRedis,
    tmp_path: Path,
) -> None:
    scene = planned(16)
    root, connection = root_of(scene), connect(redis_server.url)
    logs = {skew_s: tmp_path / f"log{skew_s}" for skew_s in (YEAR_S, -YEAR_S)}
    running = [
        skewed_worker(
            skew_s, root, redis_server.url, analytic.command(0.1), log, until_complete=True, name=f"worker{skew_s}"
        )
        for skew_s, log in logs.items()
    ]
    analytic.wait_for(lambda: len(_workers(scene)) == 2, 120)
    os.kill(analytic.child_of(running[0]), 9)
    assert [process.wait(240) for process in running] == [0, 0]
    assert scene.missing_jobs() == []
    assert queue_status(connection).failed == {}
    Store(root).sweep(stray_age_s=0)
    assert stored_bytes(scene) == clean_bytes(16)
    assert len(rows_read(scene)) == 32
    times = [json.loads(path.read_bytes())["figures"]["wall_s"] for path in (scene.folder / "committed").iterdir()]
    assert all(0 < seconds < 60 for seconds in times), "a job's seconds are those of a clock that runs evenly"


def _workers(scene: SceneStore) -> set[str]:
    return {scene.marker(job)["figures"]["worker"] for job in scene.committed_jobs()}
