"""The queue is what the store lacks; against a real server."""

import signal
import subprocess
import sys
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import queue_samples
import redis
import store_samples as samples
from rq.job import Job
from rq.serializers import JSONSerializer

from photonfarm.shared import queue
from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import (
    FUNCTION,
    QUEUE_LIMIT,
    Failure,
    connect,
    job_name,
    open_queue,
    queue_status,
    reconcile,
    reconciliation,
)
from photonfarm.shared.store import SceneStore, Store

scene = queue_samples.scene
queued = queue_samples.queued


def test_everything_missing_is_queued_once(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    samples.commit(scene, 3, samples.outputs(scene, 3))
    assert reconcile(store, connection) == 9
    assert queued(connection) == [job_name(scene.scene_id, job) for job in range(10) if job != 3]
    assert reconcile(store, connection) == 0
    job = Job.fetch(queued(connection)[0], connection=connection, serializer=JSONSerializer)  # as RQ's tools see it
    assert (job.func_name, job.kwargs, job.result_ttl) == (FUNCTION, {"scene_id": scene.scene_id, "job": 0}, 0)


def test_a_job_with_a_heartbeat_or_a_recent_failure_is_left_alone(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    queue.beat(connection, "worker", "host", job_name(scene.scene_id, 0), ttl_s=60)
    queue.record_failure(connection, job_name(scene.scene_id, 1), "it is broken")
    assert reconcile(store, connection) == 8
    status = queue_status(connection)
    assert (status.queued, status.running, status.workers) == (8, 1, 1)
    assert status.failed == {job_name(scene.scene_id, 1): Failure("it is broken", 1, set_aside=False)}
    assert reconcile(store, connection, retry_failed=True) == 1
    queue.bury(connection, "worker")
    assert reconcile(store, connection) == 1
    assert queue_status(connection).workers == 0


def test_one_scene_alone_can_be_queued(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    store.plan(samples.small_spec(points=17), Request())
    assert reconcile(store, connection, scene_id=scene.scene_id) == 10
    assert reconcile(store, connection) == 1


def test_no_more_is_queued_than_the_limit(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    assert reconcile(store, connection, limit=4) == 4
    assert reconcile(store, connection, limit=4) == 0
    open_queue(connection).pop_job_id()
    assert reconcile(store, connection, limit=4) == 1


def by_scene(connection: redis.Redis) -> list[int]:
    """How many jobs are queued of each scene, the fewest first."""
    return sorted(Counter(name.rpartition("-")[0] for name in queued(connection)).values())


def planned(store: Store, points: int, jobs: int) -> SceneStore:
    request = Request(modifications=jobs)
    return store.scene(store.plan(samples.small_spec(points=points), request, shard_rows=1).scene_id)


def test_scenes_share_the_queue(connection: redis.Redis, store: Store) -> None:
    for points, jobs in ((16, 3), (17, 30), (18, 30)):
        planned(store, points, jobs)
    assert reconcile(store, connection, limit=20) == 20
    assert by_scene(connection) == [3, 8, 9]
    assert reconcile(store, connection, limit=20) == 0


def test_a_scene_whose_jobs_nobody_takes_makes_place_for_another(connection: redis.Redis, store: Store) -> None:
    first = planned(store, 16, 30)
    assert reconcile(store, connection, limit=20) == 20
    second = planned(store, 17, 30)
    assert reconcile(store, connection, limit=20) == 10
    assert by_scene(connection) == [10, 10]
    assert queued(connection)[:10] == [job_name(first.scene_id, job) for job in range(10)]
    assert sorted(connection.keys("rq:job:*")) == sorted(f"rq:job:{name}".encode() for name in queued(connection))
    taken = []
    while len(taken) < 30:
        job, _ = queue.take(open_queue(connection), leave=[first.scene_id])
        if job is None:
            assert reconcile(store, connection, limit=20)
            continue
        taken.append(job.id)
        number = int(job.id.rpartition("-")[2])
        samples.commit(second, number, samples.outputs(second, number))
    assert sorted(taken) == sorted(job_name(second.scene_id, job) for job in range(30))
    assert reconcile(store, connection, limit=20) == 10
    assert by_scene(connection) == [20], "place that nobody else needs is taken again"


def test_a_scene_asked_for_alone_gets_its_share_too(connection: redis.Redis, store: Store) -> None:
    planned(store, 16, 30)
    reconcile(store, connection, limit=20)
    second = planned(store, 17, 4)
    assert reconcile(store, connection, scene_id=second.scene_id, limit=20) == 4
    assert by_scene(connection) == [4, 16]


def test_a_redis_that_lost_everything_is_filled_again(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    reconcile(store, connection)
    connection.flushall()
    assert reconcile(store, connection) == 10


def test_a_job_that_was_taken_by_a_worker_that_died_is_queued_again(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    reconcile(store, connection)
    jobs = open_queue(connection)
    connection.lmove(jobs.key, jobs.intermediate_queue_key)
    connection.zadd(jobs.started_job_registry.key, {f"{job_name(scene.scene_id, 1)}:execution": 2e9})
    assert reconcile(store, connection) == 1
    assert len(queued(connection)) == len(set(queued(connection))) == 10
    assert connection.llen(jobs.intermediate_queue_key) == 0
    assert connection.zcard(jobs.started_job_registry.key) == 0


def test_only_one_caller_reconciles_at_a_time(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    with connection.lock("rq:photonfarm:reconcile", timeout=10):
        assert reconcile(store, connection, wait_s=0) == 0
        with pytest.raises(QueueError, match="another process"):
            reconcile(store, connection, wait_s=0.2, retry_set_aside=True)
    assert reconcile(store, connection, wait_s=0) == 10


def test_one_that_takes_long_keeps_others_out_until_it_is_done(
    connection: redis.Redis, store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, done = threading.Event(), threading.Event()

    def fill(*_: object) -> reconciliation.Filled:
        began.set()
        return reconciliation.Filled(int(done.wait(20)), 0)

    monkeypatch.setattr(reconciliation, "LOCK_TTL_S", 1)
    with monkeypatch.context() as slow, ThreadPoolExecutor(1) as other:
        slow.setattr(reconciliation, "_reconcile", fill)
        filling = other.submit(reconcile, store, connection)
        began.wait(10)
        with pytest.raises(QueueError, match="another process"):
            reconcile(store, connection, wait_s=3)
        done.set()
        assert filling.result(10) == 1
    assert reconcile(store, connection, wait_s=0) == 10


def test_one_that_is_killed_keeps_others_out_for_seconds(
    connection: redis.Redis, common_redis: EmbeddedRedis, store: Store, scene: SceneStore
) -> None:
    code = """
import os, signal, sys
from photonfarm.shared.queue import connect, reconcile, reconciliation
from photonfarm.shared.store import Store
reconciliation._reconcile = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
reconcile(Store(sys.argv[1]), connect(sys.argv[2]))
"""
    killed = subprocess.run([sys.executable, "-c", code, store.root, common_redis.url], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert 0 < connection.pttl("rq:photonfarm:reconcile") <= 10_000
    assert reconcile(store, connection, wait_s=15) == 10


def test_a_redis_that_goes_away_is_a_queue_error(store: Store, scene: SceneStore, tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)
    for call in (lambda: reconcile(store, connection), lambda: queue_status(connection)):
        with pytest.raises(QueueError):
            call()


def test_a_plan_of_any_size_leaves_at_most_ten_thousand_jobs_in_redis(connection: redis.Redis, store: Store) -> None:
    store.plan(samples.small_spec(), Request(modifications=10_030), shard_rows=1)
    assert reconcile(store, connection) == QUEUE_LIMIT == 10_000
    assert reconcile(store, connection) == 0
    assert len(open_queue(connection)) == 10_000
