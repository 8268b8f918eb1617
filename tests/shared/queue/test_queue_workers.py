"""What Redis knows of its store, of workers and of trainers."""

import os
import subprocess
from pathlib import Path

import pytest
import queue_samples
import redis

from photonfarm.shared import queue
from photonfarm.shared.queue import queue_status, reconcile
from photonfarm.shared.store import Store

SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME


# ---------------------------------------------------------------------------------------------- one store, one Redis


def test_a_redis_serves_one_store_at_a_time(connection: redis.Redis, store: Store, tmp_path: Path) -> None:
    other = Store(tmp_path / "other", create=True)
    queue.serve(connection, store)
    assert 0 < connection.ttl(queue.SERVED) <= 120
    queue.serve(connection, store)
    named = f"{store.store_id}.*{other.store_id}.*redis://host/1"
    for refused in (queue.serve, queue.check_served, reconcile):
        swapped = (other, connection) if refused is reconcile else (connection, other)
        with pytest.raises(queue.OtherStoreError, match=named):
            refused(*swapped)
    queue.beat(connection, "worker", "host", None, ttl_s=60)
    queue.release(connection, store)
    assert connection.exists(queue.SERVED), "a worker is left"
    queue.bury(connection, "worker")
    queue.release(connection, other)
    assert connection.exists(queue.SERVED), "it is not the other's to release"
    queue.release(connection, store)
    queue.check_served(connection, other)
    queue.serve(connection, other)


@pytest.mark.parametrize("value", ["x", "", "0" * 31, "0" * 33, "G" * 32, "A" * 32, b"\xff" * 32, "x" * 100_000])
def test_what_is_no_stores_id_is_served_by_nobody(connection: redis.Redis, store: Store, value: str | bytes) -> None:
    connection.set(queue.SERVED, value, ex=60)
    queue.serve(connection, store)
    assert connection.get(queue.SERVED) == store.store_id.encode()


@pytest.mark.parametrize("ttl_s", [None, 10**6])
def test_a_store_that_would_be_served_for_ever_is_a_strangers(
    connection: redis.Redis, store: Store, ttl_s: int | None
) -> None:
    connection.set(queue.SERVED, "ab" * 16, ex=ttl_s)
    queue.check_served(connection, store)
    queue.serve(connection, store)
    assert connection.get(queue.SERVED) == store.store_id.encode()
    connection.delete(queue.SERVED)
    connection.rpush(queue.SERVED, "ab" * 16)
    queue.serve(connection, store)
    queue.release(connection, store)
    assert not connection.exists(queue.SERVED)


# --------------------------------------------------------------------------------------------- names, and what holds up


def test_a_second_worker_of_a_name_gets_a_number(connection: redis.Redis) -> None:
    mine = os.getppid()  # a process that lives
    assert queue.take_name(connection, "ada", "host", mine, ttl_s=60) == "ada"
    assert queue.take_name(connection, "ada", "host", mine, ttl_s=60) == "ada-2"
    assert queue.take_name(connection, "ada", "elsewhere", mine, ttl_s=60) == "ada-3"
    queue.bury(connection, "ada-2")
    assert connection.exists(f"{queue.WORKER}ada")
    assert queue.take_name(connection, "ada", "host", mine, ttl_s=60) == "ada-2"


def test_the_name_and_the_job_of_a_worker_that_was_killed_here_are_free_at_once(connection: redis.Redis) -> None:
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    for process in (gone.pid, os.getpid()):  # that of a container that was started again has our own number
        queue.beat(connection, "ada", "host", NAME, ttl_s=60, process=process)
        assert queue.take_name(connection, "ada", "host", os.getpid(), ttl_s=60) == "ada"
        assert not connection.exists(queue.ALIVE + NAME)


@pytest.mark.parametrize("ttl_s", [None, 10**6])
def test_a_name_that_is_held_for_ever_is_not(connection: redis.Redis, ttl_s: int | None) -> None:
    connection.set(f"{queue.WORKER}ada", "host - 1", ex=ttl_s)
    assert queue.take_name(connection, "ada", "host", os.getpid(), ttl_s=60) == "ada"


def test_what_holds_workers_up_is_told_for_a_time_and_printable(connection: redis.Redis) -> None:
    queue.report_idle(connection, "a:b", "the disk is full", {SCENE_ID: "no \x1b]file" + "x" * 9999}, ttl_s=60)
    connection.set(f"rq:photonfarm:left:{SCENE_ID[:-1]}:c", "x")
    connection.rpush("rq:photonfarm:paused:d", "x")
    assert 0 < connection.ttl("rq:photonfarm:paused:a:b") <= 60
    idle = queue_status(connection).idle_reports
    assert idle.paused == {"a:b": "the disk is full"}
    assert list(idle.left) == [SCENE_ID]
    assert idle.left[SCENE_ID]["a:b"].startswith("no  ]filexxx")
    assert len(idle.left[SCENE_ID]["a:b"]) <= 500
    queue.report_idle(connection, "a:b", None, {}, ttl_s=60)
    assert queue_status(connection).idle_reports.paused == {}
    queue.clear_idle_report(connection, "a:b", {SCENE_ID: ""})
    assert queue_status(connection).idle_reports.left == {}


# ------------------------------------------------------------------------------------------------ what is consumed


def test_what_trainers_have_used_is_told_by_scene_and_lost_with_redis(connection: redis.Redis) -> None:
    other = "f" * 32
    assert queue.consumed_samples(connection, [SCENE_ID]) == {SCENE_ID: 0}
    queue.report_consumed(connection, SCENE_ID, 100)
    queue.report_consumed(connection, other, 7)
    assert queue.consumed_samples(connection, [SCENE_ID, other]) == {SCENE_ID: 100, other: 7}
    connection.set(f"rq:photonfarm:consumed:{other}", "-12 or so")
    assert queue.consumed_samples(connection, [SCENE_ID, other]) == {SCENE_ID: 100, other: 0}
