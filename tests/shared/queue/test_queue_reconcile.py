"""The queue is what the store lacks; against a real server."""

from pathlib import Path

import pytest
import queue_samples
import redis
import store_samples as samples
from rq.job import Job
from rq.serializers import JSONSerializer

from photonfarm.core.errors import QueueError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue import reconciliation
from photonfarm.queue.connection import connect
from photonfarm.queue.job import FUNCTION, job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.store import SceneStore, Store

scene = queue_samples.scene
queued = queue_samples.queued


def test_everything_missing_is_queued_once(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    samples.commit(scene, 3, samples.outputs(scene, 3))
    assert reconcile(store, connection) == 9
    assert queued(connection) == [job_name(scene.scene_id, job) for job in range(10) if job != 3]
    assert reconcile(store, connection) == 0
    job = Job.fetch(queued(connection)[0], connection=connection, serializer=JSONSerializer)  # as RQ's tools see it
    assert (job.func_name, job.kwargs, job.result_ttl) == (FUNCTION, {"scene_id": scene.scene_id, "job": 0}, 0)


def test_a_job_that_is_started_or_set_aside_is_left_alone_and_one_whose_worker_died_is_queued_again(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    reconcile(store, connection)
    queue_samples.taken(connection, "worker")
    failed = queue_samples.failed(connection, "it is broken")
    assert reconcile(store, connection) == 0
    status = queue_status(connection)
    assert (status.queued, status.running, list(status.failed)) == (8, 1, [failed])
    connection.delete(*connection.keys("rq:execution:*"))  # as when their time is over
    assert reconcile(store, connection) == 0, "its job is in the queue again"
    assert len(queued(connection)) == 9


def test_no_more_is_queued_of_a_scene_than_the_limit(
    connection: redis.Redis, store: Store, scene: SceneStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconciliation, "QUEUE_LIMIT", 4)
    assert reconcile(store, connection) == 4
    assert reconcile(store, connection) == 0
    queue_samples.taken(connection)
    assert reconcile(store, connection) == 1
    store.plan(samples.small_spec(points=17), Request(modifications=10), shard_rows=1)
    assert reconcile(store, connection) == 4, "a scene whose jobs nobody takes is in no other's way"


def test_a_job_that_was_lost_on_the_way_is_queued_again(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    reconcile(store, connection)
    connection.lpop(open_queue(connection).key)
    assert reconcile(store, connection) == 1
    assert len(queued(connection)) == len(set(queued(connection))) == 10


def test_only_one_caller_reconciles_at_a_time(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    with connection.lock("rq:photonfarm:reconcile", timeout=10), pytest.raises(QueueError, match="another process"):
        reconcile(store, connection, wait_s=0.2, retry=True)
    assert reconcile(store, connection, wait_s=0) == 10


def test_a_redis_that_goes_away_is_a_queue_error(store: Store, scene: SceneStore, tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)
    for call in (lambda: reconcile(store, connection), lambda: queue_status(connection)):
        with pytest.raises(QueueError):
            call()
