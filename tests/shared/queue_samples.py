"""A small scene to queue, its names, and what the tests of the queue look at in Redis."""

import pytest
import redis
import store_samples as samples

from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import open_queue
from photonfarm.shared.store import SceneStore, Store

SCENE_ID = "0123456789abcdef" * 2
NAME = f"{SCENE_ID}-7"


@pytest.fixture
def scene(store: Store) -> SceneStore:
    """Ten jobs of two samples."""
    request = Request(modifications=10, views_per_modification=2)
    return store.scene(store.plan(samples.small_spec(), request, shard_rows=2).scene_id)


def pushed(connection: redis.Redis, *names: str | bytes) -> None:
    """Put names at the end of the queue."""
    connection.rpush(open_queue(connection).key, *names)


def queued(connection: redis.Redis) -> list[str]:
    """The names of all jobs in the queue, in order."""
    return open_queue(connection).get_job_ids()
