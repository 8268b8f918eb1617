"""Jobs in the queue: what is taken, what a job comes to, and that only our own function runs; against a real server."""

import logging
import pickle
import time
import zlib

import pytest
import queue_samples
import redis
from rq.job import Job
from rq.serializers import JSONSerializer

from photonfarm.core.errors import QueueError
from photonfarm.queue.job import FUNCTION, TRIES, RenderArguments
from photonfarm.queue.rq_adapter import (
    add,
    fail,
    fail_lost,
    fail_of_worker,
    finish,
    keep_alive,
    open_queue,
    queue_status,
)

SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME
OTHER_ID = "ab" * 16
taken, queued = queue_samples.taken, queue_samples.queued


@pytest.mark.parametrize("function", ["os.system", "photonfarm.core.errors.QueueError", "builtins.eval"])
def test_a_foreign_function_in_redis_is_neither_run_nor_imported_and_its_entry_thrown_away(
    connection: redis.Redis, function: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rq.job.import_attribute", lambda name: pytest.fail(f"imports {name}"))
    Job.create(function, id=NAME, args=["true"], connection=connection, serializer=JSONSerializer).save()
    connection.rpush(open_queue(connection).key, NAME)
    assert taken(connection) is None
    assert queued(connection) == []
    assert "is no job to render" in caplog.text


def test_pickles_are_not_loaded(connection: redis.Redis, caplog: pytest.LogCaptureFixture) -> None:
    add(open_queue(connection), [(SCENE_ID, 7)])
    connection.hset(Job.key_for(NAME), "data", zlib.compress(pickle.dumps((FUNCTION, None, (), {}))))
    assert taken(connection) is None
    assert "is no job to render" in caplog.text


def test_a_job_that_redis_has_lost_is_passed_over_in_silence(
    connection: redis.Redis, caplog: pytest.LogCaptureFixture
) -> None:
    add(open_queue(connection), [(SCENE_ID, 7), (SCENE_ID, 8)])
    connection.delete(Job.key_for(NAME))
    with caplog.at_level(logging.WARNING):
        assert taken(connection).job_id == f"{SCENE_ID}-8"
    assert not caplog.text


@pytest.mark.parametrize("name", ["", "nonsense", f"{SCENE_ID}-", f"{SCENE_ID}-07", f"{'A' * 32}-7", f"{SCENE_ID}-٧"])
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(QueueError):
        RenderArguments.of(name)
    assert RenderArguments.of(NAME) == (SCENE_ID, 7)


def test_jobs_of_scenes_to_leave_stay_in_their_order(connection: redis.Redis) -> None:
    add(open_queue(connection), [(OTHER_ID, 7), (OTHER_ID, 8), (SCENE_ID, 7)])
    assert taken(connection, leave=[OTHER_ID]).job_id == NAME
    assert taken(connection, leave=[OTHER_ID]) is taken(connection, scene_id=SCENE_ID) is None
    assert queued(connection) == [f"{OTHER_ID}-7", f"{OTHER_ID}-8"]
    assert taken(connection, scene_id=OTHER_ID).job_id == f"{OTHER_ID}-7"


def test_a_job_that_is_done_leaves_nothing_in_redis(connection: redis.Redis) -> None:
    jobs = open_queue(connection)
    add(jobs, [(SCENE_ID, 7)])
    execution = taken(connection)
    assert jobs.started_job_registry.get_job_ids(cleanup=False) == [NAME]
    assert queue_status(connection).running == 1
    finish(jobs, execution)
    assert not list(connection.scan_iter(f"*{SCENE_ID}*"))
    assert not connection.exists(jobs.started_job_registry.key, execution.worker_executions_key)


def test_a_job_that_fails_is_tried_again_at_the_end_until_its_tries_are_used_up(connection: redis.Redis) -> None:
    jobs = open_queue(connection)
    add(jobs, [(SCENE_ID, 7), (SCENE_ID, 8)])
    for _ in range(TRIES - 1):
        assert not fail(jobs, taken(connection, scene_id=SCENE_ID), "ValueError: broken\nby itself")
        assert queued(connection)[-1] == NAME
        assert queue_status(connection).failed == {}
        first = taken(connection)
        assert first.job_id == f"{SCENE_ID}-8"
        assert not fail(jobs, first, "stopped", counts=False)  # no try of it
    last = taken(connection)
    assert fail(jobs, last, "ValueError: broken\nby itself")
    assert queued(connection) == [f"{SCENE_ID}-8"]
    ((name, failure),) = queue_status(connection).failed.items()
    assert (name, failure.reason, failure.times, failure.set_aside) == (
        NAME,
        "ValueError: broken by itself",
        TRIES,
        True,
    )
    assert Job.fetch(NAME, connection, JSONSerializer).latest_result().exc_string == failure.reason, (
        "as RQ's tools see it"
    )
    assert not fail(jobs, last, "again"), "it is decided once"


def test_a_job_whose_worker_died_is_free_once_it_is_known_or_no_longer_told_of(connection: redis.Redis) -> None:
    jobs = open_queue(connection)
    add(jobs, [(SCENE_ID, 7), (SCENE_ID, 8), (SCENE_ID, 9)])
    taken(connection, "ada")
    fail_of_worker(connection, "ada", "it was killed", counts=True)
    assert queued(connection)[-1] == NAME
    taken(connection, "bob", ttl_s=1)
    lives = taken(connection, "eve", ttl_s=1)
    with connection.pipeline() as pipeline:
        keep_alive(jobs, lives, pipeline, 60)
        pipeline.execute()
    time.sleep(1.1)
    assert queue_status(connection).running == 1
    fail_lost(jobs)
    assert queued(connection) == [NAME, f"{SCENE_ID}-8"]


def test_a_redis_that_forgot_the_job_in_hand_is_told_of_it_again(connection: redis.Redis) -> None:
    jobs = open_queue(connection)
    add(jobs, [(SCENE_ID, 7)])
    execution = taken(connection)
    connection.flushall()
    with connection.pipeline() as pipeline:
        keep_alive(jobs, execution, pipeline, 60)
        pipeline.execute()
    assert queue_status(connection).running == 1
    fail_of_worker(connection, "worker", "killed", counts=True)  # of its tries nothing is known
    assert queue_status(connection).running == 0
    assert queued(connection) == []
