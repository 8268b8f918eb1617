"""A Redis whose store nobody works with any more is free by itself, and says when."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import queue_samples
import redis

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue.connection import connect
from photonfarm.queue.workers import SERVED, OtherStoreError, WorkerReport, check_served, serve
from photonfarm.store import Store


@pytest.fixture
def connection(tmp_path: Path) -> Iterator[redis.Redis]:
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as connected:
        yield connected


def refusal(connection: redis.Redis, store: Store) -> str:
    with pytest.raises(OtherStoreError) as caught:
        serve(connection, store)
    return str(caught.value)


def seconds_told(said: str) -> int:
    told = re.search(r"wait: this Redis is free by itself in (\d+) s$", said)
    assert told is not None, said
    return int(told[1])


def test_another_store_takes_over_when_the_time_that_it_was_told_is_over(
    connection: redis.Redis, tmp_path: Path
) -> None:
    """The owner was killed, and its heartbeat and its word stay behind."""
    store, other = (Store(tmp_path / name, create=True) for name in ("store", "other"))
    serve(connection, store)
    queue_samples.told(connection, "killed", WorkerReport(host="elsewhere", process=1))
    assert 110 <= seconds_told(refusal(connection, other)) <= 120
    connection.pexpire(SERVED, 1500)
    left_s = seconds_told(refusal(connection, other))
    assert left_s in (1, 2)
    time.sleep(left_s)
    check_served(connection, other)
    serve(connection, other)
    assert other.store_id in refusal(connection, store)


def test_the_embedded_redis_of_a_run_remembers_its_store_and_the_time_that_is_left(tmp_path: Path) -> None:
    """`photonfarm up` with another store in the --run of one that was killed waits no longer than that."""
    store, other = (Store(tmp_path / name, create=True) for name in ("store", "other"))
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as connection:
        serve(connection, store)
        connection.expire(SERVED, 60)
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as connection:
        assert 0 < seconds_told(refusal(connection, other)) <= 60
        serve(connection, store)
