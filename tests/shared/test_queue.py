"""Only our own function runs, and the queue is what the store lacks. All against a real server."""

import importlib.util
import json
import os
import pickle
import shutil
import socket
import subprocess
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis
from redis.connection import AbstractConnection as Connection
from rq.job import Callback, Job
from rq.serializers import JSONSerializer
from rq.webhook import Webhook

from photonfarm.renderer.jobs import render_shard
from photonfarm.shared import queue, submission
from photonfarm.shared.errors import IncompleteError, QueueError
from photonfarm.shared.plan import Request
from photonfarm.shared.queue import (
    FAILED,
    FUNCTION,
    QUEUE,
    QUEUE_LIMIT,
    Failure,
    RenderArguments,
    RenderJob,
    connect,
    job_name,
    open_queue,
    queue_status,
    reconcile,
    with_password_of,
)
from photonfarm.shared.redis_server import EmbeddedRedis, server_binary
from photonfarm.shared.store import SceneStore, Store

_spec = importlib.util.spec_from_file_location("store_samples", Path(__file__).with_name("store_samples.py"))
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)

SCENE_ID = "0123456789abcdef" * 2
NAME = f"{SCENE_ID}-7"
KWARGS = {"scene_id": SCENE_ID, "job": 7}
WORKERS = f"rq:workers:{QUEUE}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as running:
        yield running


@pytest.fixture
def connection(server: EmbeddedRedis) -> Iterator[redis.Redis]:
    with connect(server.url) as connected:
        connected.flushall()
        yield connected


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store", create=True)


@pytest.fixture
def scene(store: Store) -> SceneStore:
    request = Request(modifications=10, views_per_modification=2)
    return store.scene(store.plan(samples.small_spec(), request, shard_rows=2).scene_id)


# -------------------------------------------------------------------------------------------------- what may be run


def pushed(connection: redis.Redis, *names: str | bytes) -> None:
    connection.rpush(open_queue(connection).key, *names)


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


@pytest.mark.parametrize("function", ["os.system", "photonfarm.renderer.jobs.serve", "builtins.eval"])
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
    with pytest.raises(QueueError, match="job "):
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


# -------------------------------------------------------------------------------------------------------- reconcile


def queued(connection: redis.Redis) -> list[str]:
    return open_queue(connection).get_job_ids()


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
        assert reconcile(store, connection, wait_s=0.2) == 0
    assert reconcile(store, connection, wait_s=0) == 10


def test_a_redis_that_goes_away_is_a_queue_error(store: Store, scene: SceneStore, tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)
    for call in (lambda: reconcile(store, connection), lambda: queue_status(connection)):
        with pytest.raises(QueueError, match="Redis failed while"):
            call()


def test_a_plan_of_any_size_leaves_at_most_ten_thousand_jobs_in_redis(connection: redis.Redis, store: Store) -> None:
    store.plan(samples.small_spec(), Request(modifications=10_030), shard_rows=1)
    assert reconcile(store, connection) == QUEUE_LIMIT == 10_000
    assert reconcile(store, connection) == 0
    assert len(open_queue(connection)) == 10_000


# ---------------------------------------------------------------------------------------------------------- failures


def test_a_job_that_fails_three_times_is_set_aside_until_asked_for(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    name = job_name(scene.scene_id, 4)
    for times in (1, 2):
        assert queue.record_failure(connection, name, "broken") == Failure("broken", times, set_aside=False)
        assert 0 < connection.ttl(FAILED + name) <= 3600
        assert reconcile(store, connection, limit=100, retry_failed=True) == (10 if times == 1 else 0)
        open_queue(connection).delete(delete_jobs=False)
        assert reconcile(store, connection) == 10
    assert queue.record_failure(connection, name, "broken").set_aside
    open_queue(connection).delete(delete_jobs=False)
    assert connection.ttl(FAILED + name) == -1
    assert queue_status(connection).failed == {name: Failure("broken", 3, set_aside=True)}
    assert reconcile(store, connection, retry_failed=True) == 9
    assert reconcile(store, connection, retry_set_aside=True) == 1
    assert queue_status(connection).failed == {}
    assert queue.record_failure(connection, name, "broken").times == 1


def test_many_failures_are_read_in_a_few_requests(connection: redis.Redis) -> None:
    for i in range(1500):
        connection.set(f"{FAILED}{SCENE_ID}-{i}", f"why {i}", ex=None if i % 2 else 3600)
    requests, plain = [], Connection.send_packed_command
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Connection, "send_packed_command", lambda *args, **how: (requests.append(1), plain(*args, **how)))
        failed = queue_status(connection).failed
        assert len(requests) < 40
        requests.clear()
        queue.forget_failures(connection, set_aside=False)
        assert len(requests) < 40
    assert len(failed) == 1500
    assert failed[f"{SCENE_ID}-1499"] == Failure("why 1499", 1, set_aside=True)
    assert failed[f"{SCENE_ID}-1498"] == Failure("why 1498", 1, set_aside=False)
    assert len(connection.keys(f"{FAILED}*")) == 750


def test_a_job_that_has_ended_well_has_nothing_counted_against_it(connection: redis.Redis) -> None:
    for _ in range(3):
        queue.record_failure(connection, NAME, "broken")
    queue.forget_failures_of(connection, NAME)
    assert not connection.keys("rq:photonfarm:*")


def test_failures_are_grouped_by_what_they_have_in_common() -> None:
    def failed(reason: str, times: int = 1) -> Failure:
        return Failure(reason, times, set_aside=times >= 3)

    first, *others = queue.causes(
        {
            f"{SCENE_ID}-1": failed(f"IncompleteError: half A of sample {'ab' * 16} came out non-finite 3 times"),
            f"{SCENE_ID}-2": failed(f"IncompleteError: half A of sample {'cd' * 16} came out non-finite 3 times", 3),
            f"{SCENE_ID}-3": failed(f"IncompleteError: half B of sample {'ab' * 16} came out non-finite 3 times"),
            f"{SCENE_ID}-4": failed("ValueError: cannot reshape array of size -12 into shape (4,3.5)"),
            f"{SCENE_ID}-5": failed("ValueError: cannot reshape array of size 7 into shape (4,1e-3)"),
            f"{SCENE_ID}-6": failed("IncompleteError: half A of sample … came out", 2),
        }
    )
    assert first.cause == "IncompleteError: half A of sample … came out non-finite … times"
    assert (list(first.jobs), first.set_aside, first.example) == (
        [f"{SCENE_ID}-2", f"{SCENE_ID}-1"],
        1,
        f"{SCENE_ID}-2",
    )
    assert [len(cause.jobs) for cause in others] == [2, 1, 1]


def test_what_a_stranger_writes_as_a_failure_cannot_speak_to_a_terminal(connection: redis.Redis) -> None:
    connection.set(FAILED + NAME, b"\x1b]0;owned\x07\xff" + b"x" * 1_000_000)
    connection.set(f"{FAILED}../../etc", "why")
    connection.set(f"{FAILED}{SCENE_ID}-8; rm -rf ~", "why")
    ((name, failure),) = queue_status(connection).failed.items()
    assert name == NAME
    assert failure.reason.startswith(" ]0;owned")
    assert failure.reason.isprintable()
    assert len(failure.reason) <= 2000


def test_what_a_stranger_writes_as_a_heartbeat_is_no_trouble(connection: redis.Redis) -> None:
    for i, value in enumerate(("", " ", "one", "a b c", b"\x00" * 5000)):
        connection.set(f"{queue.WORKER}evil-{i}", value)
    assert "host" not in queue.hosts(connection)
    for i in range(5):
        assert queue.bury(connection, f"evil-{i}") is None


# ---------------------------------------------------------------------------------------------- one store, one Redis


def test_a_redis_serves_one_store_at_a_time(connection: redis.Redis, store: Store, tmp_path: Path) -> None:
    other = Store(tmp_path / "other", create=True)
    queue.serve(connection, store)
    assert 0 < connection.ttl(queue.SERVED) <= 120
    queue.serve(connection, store)
    named = rf"serves the store with the id {store.store_id}, and .*other has the id {other.store_id}; .*redis://host/1"
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
    queue.tell_held_up(connection, "a:b", "the disk is full", {SCENE_ID: "no \x1b]file" + "x" * 9999}, ttl_s=60)
    connection.set(f"rq:photonfarm:left:{SCENE_ID[:-1]}:c", "x")
    connection.rpush("rq:photonfarm:paused:d", "x")
    assert 0 < connection.ttl("rq:photonfarm:paused:a:b") <= 60
    held_up = queue_status(connection).held_up
    assert held_up.paused == {"a:b": "the disk is full"}
    assert list(held_up.left) == [SCENE_ID]
    assert held_up.left[SCENE_ID]["a:b"].startswith("no  ]filexxx")
    assert len(held_up.left[SCENE_ID]["a:b"]) <= 500
    queue.tell_held_up(connection, "a:b", None, {}, ttl_s=60)
    assert queue_status(connection).held_up.paused == {}
    queue.forget_held_up(connection, "a:b", {SCENE_ID: ""})
    assert queue_status(connection).held_up.left == {}


def test_a_job_that_is_put_back_is_the_next_one_and_there_once(connection: redis.Redis) -> None:
    others = [f"{SCENE_ID}-{number}" for number in (1, 2)]
    pushed(connection, NAME, *others)
    listed = open_queue(connection)
    queue.take(listed)
    for _ in range(2):
        queue.put_back(listed, NAME)
    assert queued(connection) == [NAME, *others]


# ------------------------------------------------------------------------------------------------ what is consumed


def test_what_trainers_have_used_is_told_by_scene_and_lost_with_redis(connection: redis.Redis) -> None:
    other = "f" * 32
    assert queue.consumed_samples(connection, [SCENE_ID]) == {SCENE_ID: 0}
    queue.tell_consumed(connection, SCENE_ID, 100)
    queue.tell_consumed(connection, other, 7)
    assert queue.consumed_samples(connection, [SCENE_ID, other]) == {SCENE_ID: 100, other: 7}
    connection.set(f"rq:photonfarm:consumed:{other}", "-12 or so")
    assert queue.consumed_samples(connection, [SCENE_ID, other]) == {SCENE_ID: 100, other: 0}


# ------------------------------------------------------------------------------------------------------- permissions

START = Path(__file__).parents[2] / "docker/redis.sh"
COMPOSE = Path(__file__).parents[2] / "docker-compose.yml"


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, Path]]:
    """The server as the compose file starts it: a port of it, and the file with its password."""
    folder = tmp_path_factory.mktemp("guarded")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    environment = {
        **os.environ, "REDIS_SERVER": str(server_binary()), "REDIS_DATA": str(folder), "REDIS_PORT": str(port),
        "REDIS_BIND": "127.0.0.1", "PHOTONFARM_REDIS_PASSWORD_FILE": str(folder / "password"),
    }  # fmt: skip
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(["sh", str(START)], env=environment, stdout=log) as process,
    ):
        deadline = time.monotonic() + 60
        while "eady to accept connections" not in (folder / "log").read_text():
            assert process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield port, folder / "password"
        process.terminate()


def test_the_server_of_the_compose_file_lets_nobody_in_without_the_password(guarded: tuple[int, Path]) -> None:
    port, password = guarded
    for user in ("", "default:@", "default:wrong@", "photonfarm:wrong@", "photonfarm:@"):
        with pytest.raises(QueueError, match="no Redis at"):
            connect(f"redis://{user}127.0.0.1:{port}/0")
    assert len(password.read_text().strip()) == 64


def test_who_lacks_a_name_or_a_password_is_told_which_and_nobody_to_start_a_server(
    guarded: tuple[int, Path], store: Store, tmp_path: Path
) -> None:
    port, _ = guarded
    url = f"redis://127.0.0.1:{port}/0"
    with pytest.raises(QueueError, match=r"wants a password .*PHOTONFARM_REDIS_PASSWORD_FILE names"):
        connect(url)
    (tmp_path / "password").write_text("wrong")
    with pytest.raises(QueueError, match=r"does not let in the user photonfarm .*redis://default@host"):
        connect(with_password_of(tmp_path / "password", url))
    request = {"modifications": 1, "views": 1, "passes": 1, "seed": 0}
    with pytest.raises(QueueError, match=r"submits without Redis$"):
        submission.submit("cornell", store.root, url, **request)
    with pytest.raises(QueueError, match=r"without Redis, and `redis-server` or .* starts one$"):
        submission.submit("cornell", store.root, "redis://127.0.0.1:1/0", **request)


def test_the_password_of_a_plain_redis_goes_with_the_user_that_it_has(tmp_path: Path) -> None:
    (tmp_path / "password").write_text("secret")
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as plain:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        plain.config_set("port", port)
        plain.config_set("requirepass", "secret")
        with pytest.raises(QueueError, match="a Redis with `requirepass` has the user default: redis://default@host"):
            connect(with_password_of(tmp_path / "password", f"redis://127.0.0.1:{port}/0"))
        with connect(with_password_of(tmp_path / "password", f"redis://default@127.0.0.1:{port}/0")) as let_in:
            assert let_in.ping()


def test_rq_and_all_of_ours_work_with_the_permissions_of_the_compose_file(
    guarded: tuple[int, Path], store: Store, scene: SceneStore
) -> None:
    port, password = guarded
    with connect(with_password_of(password, f"redis://127.0.0.1:{port}/0")) as limited:
        assert reconcile(store, limited) == 10
        queue.beat(limited, "worker", "host", "job", ttl_s=60)
        queue.record_failure(limited, NAME, "broken")
        queue.tell_consumed(limited, SCENE_ID, 1)
        assert queue_status(limited).queued == 10
        assert queue.take_name(limited, "worker", "host", os.getppid(), ttl_s=60) == "worker-2"
        queue.tell_held_up(limited, "worker", "full", {SCENE_ID: "gone"}, ttl_s=60)
        for name in ("worker", "worker-2"):
            queue.bury(limited, name)
        assert queue.hosts(limited) == set()
        queue.release(limited, store)
        assert queue.count_start(limited, NAME) == queue.count_overdue(limited, NAME) == 1
        assert queue.take(open_queue(limited))[0] is not None
        forbidden = (
            ("FLUSHALL",), ("CONFIG", "GET", "dir"), ("KEYS", "*"), ("SHUTDOWN",), ("ACL", "LIST"),
            ("SET", "other", "1"), ("PUBLISH", "rq:pubsub:x", "{}"), ("MODULE", "LIST"), ("REPLICAOF", "h", "1"),
        )  # fmt: skip
        for command in forbidden:
            with pytest.raises(redis.exceptions.NoPermissionError):
                limited.execute_command(*command)
        with pytest.raises(redis.RedisError):
            limited.set("rq:large", b"x" * (2 << 20))


def test_the_health_check_of_the_compose_file_shows_the_password_to_nobody(
    guarded: tuple[int, Path], tmp_path: Path
) -> None:
    """It is run with a `redis-cli` that tells what it was given, and then does its work if it is there."""
    port, password = guarded
    (line,) = [line for line in COMPOSE.read_text().splitlines() if "redis-cli" in line]
    _, check = json.loads(line.partition(": ")[2])
    real = shutil.which("redis-cli")
    told, fake = tmp_path / "told", tmp_path / "redis-cli"
    ping = f'exec "{real}" -p {port} "$@"' if real else "read -r word; [ ${#word} = 64 ] && echo PONG"
    fake.write_text(f'#!/bin/sh\nenv > "{told}"\necho "$@" >> "{told}"\n{ping}\n')
    fake.chmod(0o755)

    def rc(file: Path) -> int:
        command = check.replace("$$", "$").replace("/run/photonfarm/redis_password", str(file))
        environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        return subprocess.run(["sh", "-c", command], env=environment, check=False, stderr=subprocess.DEVNULL).returncode

    assert rc(password) == 0
    assert "ping" in told.read_text()
    assert password.read_text().strip() not in told.read_text()
    (tmp_path / "wrong").write_text("wrong\n")
    assert rc(tmp_path / "wrong") != 0


# ---------------------------------------------------------------------------------------------------------- passwords

SECRET = "hunter2"


@pytest.mark.parametrize(
    "url",
    [
        f"redis://user:{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}/x@127.0.0.1:1/0",
        f"redis://:12/{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}?x@127.0.0.1:1/0",
        f"redis://:{SECRET}#x@127.0.0.1:1/0",
        f"redis://:a@{SECRET}@127.0.0.1:1/0",
        f"redis://user:{SECRET}@127.0.0.1:port/0",
        f"redis://127.0.0.1:1/0?password={SECRET}",
        f"redis://127.0.0.1:1/0?password=x@{SECRET}",
        f"unix://user:{SECRET}@/nowhere/redis.sock",
        f"user:{SECRET}@127.0.0.1",
        f"http://user:{SECRET}@127.0.0.1:1",
        f"redis://user:{SECRET}@[127.0.0.1:1/0",
    ],
)
def test_a_password_is_in_no_message_and_in_no_traceback(url: str) -> None:
    with pytest.raises(QueueError) as caught:
        connect(url)
    assert SECRET not in "".join(traceback.format_exception(caught.value))
    assert "no Redis at" in str(caught.value)


def test_a_password_that_is_wrong_is_in_no_message(guarded: tuple[int, Path]) -> None:
    with pytest.raises(QueueError, match="no Redis at redis:") as caught:
        connect(f"redis://photonfarm:{SECRET}@127.0.0.1:{guarded[0]}/0")
    assert SECRET not in "".join(traceback.format_exception(caught.value))


def test_a_password_comes_from_a_file_where_the_url_has_none(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("a/b@c:d\n")
    quoted = "a%2Fb%40c%3Ad"
    assert with_password_of(file, "redis://h:1/0") == f"redis://photonfarm:{quoted}@h:1/0"
    assert with_password_of(file, "rediss://ada@h:1/0?x=1") == f"rediss://ada:{quoted}@h:1/0?x=1"
    for url in ("redis://ada:own@h:1/0", "unix:///run/redis.sock"):
        assert with_password_of(file, url) == url
    assert with_password_of(None, "redis://h:1/0") == "redis://h:1/0"
    with pytest.raises(QueueError, match="the Redis password cannot be read: No such file"):
        with_password_of(tmp_path / "none", "redis://h:1/0")
