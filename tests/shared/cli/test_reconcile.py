"""`reconcile`, which fills the queue of a farm that may have no worker."""

import json
from pathlib import Path

import pytest
import queue_samples
from click.testing import CliRunner, Result
from redis import Redis

from photonfarm.cli.farm_verbs import reconcile
from photonfarm.core.errors import StoreError
from photonfarm.farm import submission
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.scene.spec_loading import NamedSpec


def ran(store: Path, url: str, *options: str) -> Result:
    return CliRunner().invoke(reconcile, ["--store", str(store), "--redis", url, *options])


@pytest.fixture
def planned(tmp_path: Path) -> Path:
    """A store with a plan of four jobs, of which no Redis knows."""
    submission.submit(NamedSpec.load("cornell"), tmp_path / "store", None, Request(modifications=4), shard_rows=1)
    return tmp_path / "store"


def test_what_is_missing_is_queued_once_and_again_after_redis_was_emptied(
    planned: Path, connection: Redis, common_redis: EmbeddedRedis
) -> None:
    assert ran(planned, common_redis.url).output == "4 jobs queued\n"
    assert json.loads(ran(planned, common_redis.url, "--json").output) == {"queued": 0}
    connection.flushall()
    assert json.loads(ran(planned, common_redis.url, "--json").output) == {"queued": 4}


def test_a_job_whose_worker_died_is_queued_again_and_a_failed_one_is_left_alone(
    planned: Path, connection: Redis, common_redis: EmbeddedRedis
) -> None:
    ran(planned, common_redis.url)
    died = queue_samples.taken(connection)
    queue_samples.failed(connection, "broken")
    connection.delete(died.key)  # as when its time is over
    assert ran(planned, common_redis.url).output == "0 jobs queued\n"
    assert queue_samples.queued(connection)[-1] == died.job_id


def test_without_a_store_there_is_nothing_to_queue(tmp_path: Path, common_redis: EmbeddedRedis) -> None:
    assert isinstance(ran(tmp_path / "none", common_redis.url).exception, StoreError)
