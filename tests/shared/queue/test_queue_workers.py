"""What Redis knows of its store, of workers and of trainers."""

import os
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest
import queue_samples
import redis
from rq import Worker

from photonfarm.queue.job import QUEUE
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import QueueStatus, queue_status
from photonfarm.queue.workers import (
    SERVED,
    WORKER,
    Activity,
    OtherStoreError,
    WorkerReport,
    bury,
    check_served,
    read_consumed,
    read_workers,
    release,
    report_consumed,
    serve,
    take_name,
)
from photonfarm.store import Store

SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME
FAR = WorkerReport(host="elsewhere", process=1)
told = queue_samples.told


# ---------------------------------------------------------------------------------------------- one store, one Redis


def test_a_redis_serves_one_store_at_a_time(connection: redis.Redis, store: Store, tmp_path: Path) -> None:
    other = Store(tmp_path / "other", create=True)
    serve(connection, store)
    assert 0 < connection.ttl(SERVED) <= 120
    serve(connection, store)
    named = f"{store.store_id}.*{other.store_id}.*redis://host/1"
    for refused in (serve, check_served, reconcile):
        swapped = (other, connection) if refused is reconcile else (connection, other)
        with pytest.raises(OtherStoreError, match=named):
            refused(*swapped)
    told(connection, "worker", FAR)
    release(connection, store)
    assert connection.exists(SERVED), "a worker is left"
    bury(connection, "worker")
    release(connection, other)
    assert connection.exists(SERVED), "it is not the other's to release"
    release(connection, store)
    check_served(connection, other)
    serve(connection, other)
    connection.pexpire(SERVED, 600)  # its owner was killed
    with pytest.raises(OtherStoreError, match=r"free by itself in 1 s$"):
        serve(connection, store)
    time.sleep(0.7)
    serve(connection, store)


# --------------------------------------------------------------------------------------------- names, and what holds up


def test_a_second_worker_of_a_name_gets_a_number(connection: redis.Redis) -> None:
    assert take_name(connection, "ada", ttl_s=60) == "ada"
    assert take_name(connection, "ada", ttl_s=60) == "ada-2"
    told(connection, "bob", FAR)
    assert take_name(connection, "bob", ttl_s=60) == "bob-2"
    bury(connection, "ada-2")
    assert connection.exists(f"{WORKER}ada")
    assert take_name(connection, "ada", ttl_s=60) == "ada-2"


def test_a_worker_that_was_killed_here_is_gone_at_once_and_its_name_free(connection: redis.Redis) -> None:
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    told(connection, "ada", WorkerReport(process=gone.pid))
    assert read_workers(connection) == {}
    assert take_name(connection, "ada", ttl_s=60) == "ada"
    assert read_workers(connection) == {"ada": WorkerReport(process=os.getpid())}


def test_workers_are_told_of_as_rq_does_for_a_time_and_again_after_redis_lost_them(connection: redis.Redis) -> None:
    report = WorkerReport(
        doing=Activity("renders samples", 3, 8, NAME), paused="the disk is full", left={SCENE_ID: "no file"}
    )
    for _ in range(2):
        told(connection, "a:b", report)
        assert 0 < connection.pttl(f"{WORKER}a:b") <= 60_000
        (worker,) = Worker.all(connection)
        assert (worker.name, worker.pid, worker.queue_names()) == ("a:b", os.getpid(), [QUEUE])
        status = queue_status(connection)
        assert (status.workers, status.paused, status.skipped) == (
            1,
            {"a:b": "the disk is full"},
            {SCENE_ID: {"a:b": "no file"}},
        )
        assert status.activities == {"a:b": report.doing}
        assert str(report.doing) == "renders samples 3/8"
        connection.flushall()
    told(connection, "a:b", replace(report, paused=None, left={}, doing=None))
    assert queue_status(connection) == QueueStatus(0, 0, 1, {})
    connection.delete(f"{WORKER}a:b")  # as when its time is over
    assert queue_status(connection).workers == 0
    assert not connection.keys("*")


# ------------------------------------------------------------------------------------------------ what is consumed


def test_what_trainers_have_used_is_told_by_scene_and_lost_with_redis(connection: redis.Redis) -> None:
    other = "f" * 32
    assert read_consumed(connection, []) == {}
    assert read_consumed(connection, [SCENE_ID]) == {SCENE_ID: 0}
    report_consumed(connection, SCENE_ID, 100)
    report_consumed(connection, other, 7)
    assert read_consumed(connection, [SCENE_ID, other]) == {SCENE_ID: 100, other: 7}
