"""Keys of Redis that a stranger has made something else of: they stop neither the refill of the queue nor a worker."""

import os
import signal
from pathlib import Path
from types import ModuleType

import pytest
from redis_stranger import KEY, limited_url

from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import ALIVE, QUEUE, connect, job_name, queue_status, reconcile
from photonfarm.shared.store import Store

LONG_KEYS, LONG = 100, 1_000_000

SMALL_ENTRIES = {
    "a stranger among the workers": ("SADD", f"rq:workers:{QUEUE}", "evil"),
    "a queue that is none": ("SET", KEY, "x"),
    "taken jobs that are none": ("SET", f"{KEY}:intermediate", "x"),
    "running jobs that are none": ("SET", f"rq:wip:{QUEUE}", "x"),
    "failed jobs that are none": ("SET", f"rq:failed:{QUEUE}", "x"),
    "workers that are none": ("SET", f"rq:workers:{QUEUE}", "x"),
    "all workers that are none": ("SET", "rq:workers", "x"),
    "queues that are none": ("SET", "rq:queues", "x"),
    "a lock for ever": ("SET", "rq:photonfarm:reconcile", "x"),
    "a store for ever": ("SET", "rq:photonfarm:store", "ab" * 16),
    "taken jobs that are no text": ("RPUSH", f"{KEY}:intermediate", b"\xff"),
}


@pytest.fixture
def store(analytic: ModuleType, tmp_path: Path) -> Store:
    """A store with a scene of 3 jobs."""
    store = Store(tmp_path / "store", create=True)
    store.plan(analytic.small_spec(), Request(modifications=3), shard_rows=1)
    return store


@pytest.mark.parametrize("entry", SMALL_ENTRIES.values(), ids=SMALL_ENTRIES.keys())
def test_one_entry_does_not_stop_the_refill_nor_do_so_after_a_restart(
    store: Store, tmp_path: Path, entry: tuple[str | bytes, ...]
) -> None:
    """Strangers who have the password may do as much as we may do ourselves."""
    with EmbeddedRedis(tmp_path / "redis") as running:
        administrator = connect(running.url)
        administrator.config_set("appendfsync", "always")
        connect(limited_url(administrator, running.url)).execute_command(*entry)
        os.kill(running.pid, signal.SIGKILL)
        os.waitid(os.P_PID, running.pid, os.WEXITED | os.WNOWAIT)
        running.keep_running()
        administrator = connect(running.url)
        assert administrator.exists(entry[1]), "it has outlived the server"
        limited = connect(limited_url(administrator, running.url))
        assert reconcile(store, limited, wait_s=0) == 3
        assert queue_status(limited).queued == 3


def test_a_worker_renders_whatever_has_become_of_its_keys(
    store: Store, server: EmbeddedRedis, analytic: ModuleType, tmp_path: Path
) -> None:
    """Its start, its taking of jobs and their accounts meet keys of other kinds, also while it runs."""
    (scene,) = store.scenes()
    names = [job_name(scene.scene_id, job) for job in range(3)]
    with connect(server.url) as connection:
        connection.flushall()
        url = limited_url(connection, server.url)
        for command, key, value in SMALL_ENTRIES.values():
            if not connection.exists(key):
                connection.execute_command(command, key, value)
        for before in ("rq:job:", "rq:executions:", "rq:results:", "rq:photonfarm:starts:", "rq:photonfarm:failures:"):
            for name in names:
                connection.set(before + name, "x")
        with analytic.start_worker(store.root, url, analytic.command(0.3), tmp_path / "log") as running:
            analytic.wait_for(lambda: scene.committed_jobs(), 120)
            connection.delete(KEY)
            connection.set(KEY, "x")
            analytic.wait_for(lambda: scene.missing_jobs() == [], 120)
            running.terminate()
            assert running.wait(60) == 0
        assert queue_status(connection).failed == {}


def test_long_names_stay_in_redis(store: Store, server: EmbeddedRedis) -> None:
    with connect(server.url) as connection:
        connection.flushall()
        limited = connect(limited_url(connection, server.url))
        for i in range(LONG_KEYS):
            limited.set(f"{ALIVE}{i}".encode() + b"x" * (LONG - 10), 1)
        script = f"for i = 1, {LONG_KEYS} do redis.call('SADD', KEYS[1], i .. string.rep('x', {LONG})) end"
        limited.eval(script, 1, f"rq:workers:{QUEUE}")
        sent = connection.info("stats")["total_net_output_bytes"]
        assert reconcile(store, limited) == 3
        assert queue_status(limited).running == 0
        assert connection.info("stats")["total_net_output_bytes"] - sent < 100_000
        connection.flushall()
