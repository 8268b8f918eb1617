"""What somebody else wrote into Redis under our keys stops nothing, and is not fetched where it is long."""

import pytest
import queue_samples
import redis

from photonfarm.shared import queue
from photonfarm.shared.queue import FAILED, QUEUE, Failure, job_name, open_queue, queue_status, reconcile
from photonfarm.shared.store import SceneStore, Store

scene = queue_samples.scene
SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME
pushed, queued = queue_samples.pushed, queue_samples.queued
WORKERS = f"rq:workers:{QUEUE}"


def test_entries_too_long_for_a_job_are_not_fetched_when_the_queue_is_filled(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    listed = open_queue(connection)
    for key in (listed.key, listed.intermediate_queue_key):
        pushed(connection, NAME)
        connection.rpush(key, b"x" * 1_000_000)
    connection.zadd(listed.started_job_registry.key, {b"x" * 1_000_000: 2e9})
    sent = connection.info("stats")["total_net_output_bytes"]
    assert reconcile(store, connection) == 10
    assert connection.info("stats")["total_net_output_bytes"] - sent < 100_000


def test_names_too_long_for_ours_are_not_fetched(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    """Keys with our prefixes, and members of RQ's registry of workers; what is short is there for us all the same."""
    queue.beat(connection, "worker", "host", job_name(scene.scene_id, 0), ttl_s=60)
    queue.record_failure(connection, job_name(scene.scene_id, 1), "broken")
    for i in range(8):
        long = b"%d" % i + b"x" * 1_000_000
        for prefix in (queue.ALIVE, FAILED, queue.WORKER):
            connection.set(prefix.encode() + long, 1)
        connection.sadd(WORKERS, long, b"rq:worker:" + long)
    sent = connection.info("stats")["total_net_output_bytes"]
    assert reconcile(store, connection) == 8
    status = queue_status(connection)
    assert (status.running, status.workers, len(status.failed)) == (1, 1, 1)
    assert queue.hosts(connection) == {"host"}
    assert connection.info("stats")["total_net_output_bytes"] - sent < 100_000
    assert not connection.exists(WORKERS)


def test_workers_that_are_gone_and_what_is_no_worker_leave_the_registry(connection: redis.Redis, store: Store) -> None:
    lives, gone, strange = "rq:worker:lives", "rq:worker:gone", ["evil", "", "rq:job:x", b"\xff"]
    connection.hset(lives, "birth", 1)
    connection.sadd(WORKERS, lives, gone, *strange)
    connection.sadd("rq:workers", lives, gone, *strange, "rq:worker:of-another-queue")
    reconcile(store, connection)
    assert connection.smembers(WORKERS) == {lives.encode()}
    assert connection.smembers("rq:workers") == {lives.encode(), b"rq:worker:of-another-queue"}


def test_a_registry_without_end_does_not_hold_redis_up(connection: redis.Redis, store: Store) -> None:
    connection.sadd(WORKERS, *(f"evil-{i}" for i in range(5000)))
    reconcile(store, connection)
    assert connection.scard(WORKERS) == 4000
    for _ in range(4):
        reconcile(store, connection)
    assert not connection.exists(WORKERS)


FIXED_KEYS = [
    f"rq:queue:{QUEUE}", f"rq:queue:{QUEUE}:intermediate", f"rq:wip:{QUEUE}", f"rq:failed:{QUEUE}", "rq:queues",
    "rq:workers", WORKERS, "rq:photonfarm:reconcile",
]  # fmt: skip
JOBS_KEYS = ["rq:job:", "rq:executions:", "rq:results:", queue.STARTS, queue.OVERDUE, "rq:photonfarm:failures:"]


@pytest.mark.parametrize("key", [*FIXED_KEYS, *JOBS_KEYS])
@pytest.mark.parametrize("kind", ["string", "stream"])
def test_a_key_that_has_become_one_of_another_kind_stops_nothing(
    connection: redis.Redis, store: Store, scene: SceneStore, key: str, kind: str
) -> None:
    names = [job_name(scene.scene_id, job) for job in range(10)]
    for name in [""] if key in FIXED_KEYS else names:
        if kind == "string":
            connection.set(key + name, "x")
        else:
            connection.xadd(key + name, {"x": "x"})
    assert reconcile(store, connection) == 10
    assert queued(connection) == names
    job, _ = queue.take(open_queue(connection))
    connection.incr(queue.STARTS + job.id)
    connection.xadd(f"rq:results:{job.id}", {"x": "x"})
    connection.zadd(f"rq:executions:{job.id}", {"x": 1})
    assert queue.record_failure(connection, job.id, "broken").times == 1
    assert queue_status(connection).queued == 9


@pytest.mark.parametrize("count", ["x", "-1", "1e3", "9" * 30, "9" * 10_000])
def test_a_count_that_is_none_begins_anew(connection: redis.Redis, count: str) -> None:
    connection.set(f"rq:photonfarm:failures:{NAME}", count)
    assert queue.record_failure(connection, NAME, "broken").times == 1
    assert queue.record_failure(connection, NAME, "broken").times == 2


def test_values_of_another_kind_are_read_as_none(connection: redis.Redis) -> None:
    for key in (
        FAILED + NAME,
        f"rq:photonfarm:failures:{NAME}",
        queue.WORKER + "evil",
        f"rq:photonfarm:consumed:{SCENE_ID}",
    ):
        connection.rpush(key, "x")
    assert queue_status(connection).failed == {NAME: Failure("", 1, set_aside=True)}
    assert queue.hosts(connection) == set()
    assert queue.job_of_worker(connection, "evil") is None
    assert queue.consumed_samples(connection, [SCENE_ID]) == {SCENE_ID: 0}


def test_entries_that_are_no_text_are_tidied_away(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    listed = open_queue(connection)
    connection.rpush(listed.key, b"\xff\xfe-1")
    connection.rpush(listed.intermediate_queue_key, b"\xff\xfe-2")
    connection.zadd(listed.started_job_registry.key, {b"\xff\xfe-3:execution": 2e9})
    assert reconcile(store, connection) == 10
    assert connection.llen(listed.intermediate_queue_key) == connection.zcard(listed.started_job_registry.key) == 0


@pytest.mark.parametrize("ttl_s", [None, 3600])
def test_a_lock_that_is_not_ours_is_broken(
    connection: redis.Redis, store: Store, scene: SceneStore, ttl_s: int | None
) -> None:
    connection.set("rq:photonfarm:reconcile", "x", ex=ttl_s)
    assert reconcile(store, connection, wait_s=0) == 10


@pytest.mark.parametrize("ttl_s", [None, 10**6])
def test_a_heartbeat_that_does_not_end_is_none(
    connection: redis.Redis, store: Store, scene: SceneStore, ttl_s: int | None
) -> None:
    for job in range(10):
        connection.set(queue.ALIVE + job_name(scene.scene_id, job), "x", ex=ttl_s)
    queue.beat(connection, "worker", "host", job_name(scene.scene_id, 3), ttl_s=120)
    assert reconcile(store, connection) == 9
    assert queue_status(connection).running == 1


def test_what_a_stranger_writes_as_a_heartbeat_is_no_trouble(connection: redis.Redis) -> None:
    for i, value in enumerate(("", " ", "one", "a b c", b"\x00" * 5000)):
        connection.set(f"{queue.WORKER}evil-{i}", value)
    assert "host" not in queue.hosts(connection)
    for i in range(5):
        assert queue.bury(connection, f"evil-{i}") is None
