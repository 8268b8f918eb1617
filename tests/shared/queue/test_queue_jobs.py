"""Only our own function runs, whatever Redis says a job is; against a real server."""

import pickle
import zlib
from pathlib import Path

import pytest
import queue_samples
import redis
from rq.job import Callback, Job
from rq.serializers import JSONSerializer
from rq.webhook import Webhook

from photonfarm.renderer.jobs.render import render_shard
from photonfarm.shared import queue
from photonfarm.shared.core.errors import IncompleteError, QueueError
from photonfarm.shared.queue import FUNCTION, QUEUE, RenderArguments, RenderJob, open_queue

SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME
pushed, queued = queue_samples.pushed, queue_samples.queued
KWARGS = {"scene_id": SCENE_ID, "job": 7}


def stored(connection: redis.Redis, function: str = FUNCTION, **more: object) -> Job:
    """A job of ours, written into Redis by plain RQ as somebody else likes it, and taken by our own code."""
    job = Job.create(function, id=NAME, connection=connection, serializer=JSONSerializer, **more)
    job.save()
    pushed(connection, NAME)
    taken, strangers = queue.take(open_queue(connection))
    assert isinstance(taken, RenderJob)
    assert strangers == 0
    return taken


def assert_is_ours(job: Job) -> None:
    assert (job.func_name, job.instance, job.args, job.kwargs) == (FUNCTION, None, (), KWARGS)
    assert job.func is render_shard
    assert job.success_callback is job.failure_callback is job.stopped_callback is None
    assert (job.webhooks, job.retries_left, job.repeats_left, job.group_id) == ([], None, None, None)
    assert (job.result_ttl, job.timeout, job.origin, job.get_status()) == (0, 7 * 86400, QUEUE, "queued")


def test_a_job_is_what_its_name_tells(connection: redis.Redis) -> None:
    assert_is_ours(stored(connection, kwargs=KWARGS))


@pytest.mark.parametrize("function", ["os.system", "photonfarm.renderer.jobs.render.serve", "builtins.eval"])
def test_another_function_in_redis_is_not_looked_at(connection: redis.Redis, function: str) -> None:
    assert_is_ours(stored(connection, function, args=["true"], kwargs={"command": "true"}))


def test_callbacks_webhooks_retries_repetitions_and_groups_in_redis_are_not_looked_at(connection: redis.Redis) -> None:
    evil = Callback("os.system")
    webhook = Webhook("http://127.0.0.1:1/", "finished")
    job = Job.create(
        "os.system", id=NAME, connection=connection, serializer=JSONSerializer, timeout=1, result_ttl=-1,
        on_success=evil, on_failure=evil, on_stopped=evil, webhooks=[webhook], group_id="evil", origin="elsewhere",
    )  # fmt: skip
    job.repeats_left, job.retries_left = 3, 3
    job.save()
    pushed(connection, NAME)
    assert_is_ours(queue.take(open_queue(connection))[0])


@pytest.mark.parametrize("field", ["data", "meta", "result", "status", "webhooks", "created_at"])
def test_neither_pickles_nor_nonsense_are_read(connection: redis.Redis, field: str, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "owned",))

    for evil in (pickle.dumps(Evil()), zlib.compress(pickle.dumps(Evil())), b"\xff" * 100):
        connection.hset(f"rq:job:{NAME}", field, evil)
        pushed(connection, NAME)
        assert_is_ours(queue.take(open_queue(connection))[0])
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "../../etc/passwd-0",
        f"../../{SCENE_ID}-7",
        f"{SCENE_ID}/../x-7",
        f"{SCENE_ID}--7",
        f"{SCENE_ID}-07",
        f"{SCENE_ID}-7\n",
        f"{SCENE_ID}-٧",
        f"{SCENE_ID.upper()}-7",
        f"{SCENE_ID}-{1 << 48}",
        SCENE_ID,
        "",
        "-",
        "x" * 1_000_000,
    ],
)
def test_what_is_not_named_as_a_job_is_thrown_away_and_what_comes_after_it_taken(
    connection: redis.Redis, name: str
) -> None:
    pushed(connection, name, NAME)
    listed = open_queue(connection)
    job, strangers = queue.take(listed)
    if job is None:  # well formed, and yet not a name
        job, more = queue.take(listed)
        strangers += more
    assert strangers == 1
    assert_is_ours(job)
    assert queue.take(listed) == (None, 0)
    assert connection.lrange(listed.intermediate_queue_key, 0, -1) == [NAME.encode()]
    with pytest.raises(QueueError):
        RenderArguments.of(name)


def test_jobs_of_scenes_to_leave_stay_in_their_order(connection: redis.Redis) -> None:
    left, listed = [f"{'ab' * 16}-{number}" for number in (7, 8)], open_queue(connection)
    pushed(connection, left[0], "nonsense", left[1], NAME)
    job, strangers = queue.take(listed, leave=["ab" * 16])
    assert_is_ours(job)
    assert strangers == 1
    assert queue.take(listed, leave=["ab" * 16]) == (None, 0)
    assert connection.lrange(listed.key, 0, -1) == [name.encode() for name in left]
    assert connection.lrange(listed.intermediate_queue_key, 0, -1) == [NAME.encode()]


def test_a_job_named_in_a_dead_encoding_is_thrown_away(connection: redis.Redis) -> None:
    pushed(connection, b"\xff\xfe-7", pickle.dumps(NAME))
    assert queue.take(open_queue(connection)) == (None, 2)


def test_what_redis_holds_of_a_job_stays_there(connection: redis.Redis) -> None:
    """8 MB under the job's key, a bomb of zeros, and 8 MB in the queue itself."""
    large = 8 << 20
    connection.eval(
        "local large = string.rep(string.rep('x', 1048576), 8) "
        "redis.call('HSET', KEYS[1], 'data', large) redis.call('RPUSH', KEYS[2], large, ARGV[1])",
        2, f"rq:job:{NAME}", open_queue(connection).key, NAME,
    )  # fmt: skip
    connection.hset(f"rq:job:{NAME}", "meta", zlib.compress(b"0" * large))
    sent = connection.info("stats")["total_net_output_bytes"]
    job, strangers = queue.take(open_queue(connection))
    assert connection.info("stats")["total_net_output_bytes"] - sent < 20_000
    assert_is_ours(job)
    assert strangers == 1


def test_a_refused_job_does_not_run(connection: redis.Redis) -> None:
    job = stored(connection)
    job.refuse("its worker died")
    with pytest.raises(IncompleteError, match="its worker died"):
        job.perform()


def test_a_finished_job_sets_no_dependents_free(connection: redis.Redis) -> None:
    listed = open_queue(connection)
    Job.create("os.system", id="evil", connection=connection, serializer=JSONSerializer, origin=QUEUE).save()
    connection.sadd(Job.dependents_key_for(NAME), "evil")
    listed.enqueue_dependents(stored(connection))
    assert listed.get_job_ids() == []


def test_a_job_that_is_put_back_is_the_next_one_and_there_once(connection: redis.Redis) -> None:
    others = [f"{SCENE_ID}-{number}" for number in (1, 2)]
    pushed(connection, NAME, *others)
    listed = open_queue(connection)
    queue.take(listed)
    for _ in range(2):
        queue.put_back(listed, NAME)
    assert queued(connection) == [NAME, *others]
