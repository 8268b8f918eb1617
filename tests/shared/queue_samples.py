"""A small scene to queue, its names, and what the tests of the queue look at in Redis."""

from typing import Any

import pytest
import redis
import store_samples as samples

from photonfarm.plan.request import Request
from photonfarm.queue.rq_adapter import Execution, fail, open_queue, take
from photonfarm.queue.workers import WorkerReport, beat
from photonfarm.store import SceneStore, Store

SCENE_ID = "0123456789abcdef" * 2
NAME = f"{SCENE_ID}-7"


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Ten jobs of two samples."""
    request = Request(modifications=10, views_per_modification=2)
    return store.scene(store.plan(samples.small_spec(), request, shard_rows=2).scene_id)


def taken(connection: redis.Redis, worker: str = "worker", *, ttl_s: int = 60, **how: Any) -> Execution | None:
    """The next job, started by a worker."""
    return take(open_queue(connection), worker, ttl_s=ttl_s, **how)


def failed(connection: redis.Redis, reason: str) -> str:
    """Take the next job and let it fail, so often that it is set aside; its name."""
    execution = taken(connection)
    assert execution is not None
    job, listed = execution.job, open_queue(connection)
    job.retries_left = 0
    job.save()
    assert fail(listed, execution, reason)
    return job.id


def queued(connection: redis.Redis) -> list[str]:
    """The names of all jobs in the queue, in order."""
    return open_queue(connection).get_job_ids()


def told(connection: redis.Redis, name: str, report: WorkerReport, *, ttl_s: float = 60) -> None:
    """Write a worker's heartbeat."""
    with connection.pipeline() as pipeline:
        beat(pipeline, name, report, ttl_s=ttl_s)
        pipeline.execute()
