"""Only our own function runs, and the queue is what the store lacks. All against a real server."""

import importlib.util
import pickle
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis
from rq.job import Callback, Job
from rq.serializers import JSONSerializer

from photonfarm.shared import queue
from photonfarm.shared.errors import IncompleteError, QueueError
from photonfarm.shared.plan import Request
from photonfarm.shared.queue import FUNCTION, RenderJob, connect, job_name, open_queue, queue_status, reconcile
from photonfarm.shared.redis_server import EmbeddedRedis
from photonfarm.shared.store import SceneStore, Store

_spec = importlib.util.spec_from_file_location("store_samples", Path(__file__).with_name("store_samples.py"))
samples = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(samples)

SCENE_ID = "0123456789abcdef" * 2
NAME = f"{SCENE_ID}-7"
KWARGS = {"scene_id": SCENE_ID, "job": 7}


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


def stored(connection: redis.Redis, function: str, *, kwargs: object = KWARGS, name: str = NAME, **more: object) -> Job:
    """A job written into Redis by plain RQ, read back by our class."""
    job = Job.create(function, kwargs=kwargs, id=name, connection=connection, serializer=JSONSerializer, **more)
    job.save()
    return RenderJob.fetch(name, connection=connection, serializer=JSONSerializer)


def test_our_function_with_good_arguments_is_allowed(connection: redis.Redis) -> None:
    assert stored(connection, FUNCTION).arguments().job == 7


@pytest.mark.parametrize(
    "function", ["os.system", "photonfarm.renderer.jobs.serve", "builtins.eval", "subprocess.call"]
)
def test_any_other_function_is_refused(connection: redis.Redis, function: str, tmp_path: Path) -> None:
    job = stored(connection, function, kwargs={"command": f"touch {tmp_path}/owned"})
    with pytest.raises(QueueError, match=f"'{function}' is refused; only {FUNCTION} may be run"):
        job.perform()
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"scene_id": "../../etc", "job": 0},
        {"scene_id": SCENE_ID, "job": -1},
        {"scene_id": SCENE_ID, "job": "7"},
        {"scene_id": SCENE_ID, "job": True},
        {"scene_id": SCENE_ID.upper(), "job": 7},
        {"scene_id": SCENE_ID, "job": 7, "store": "/elsewhere"},
        {"scene_id": SCENE_ID},
        {"scene_id": SCENE_ID, "job": 8},
    ],
)
def test_our_function_with_other_arguments_is_refused(connection: redis.Redis, wrong: dict[str, object]) -> None:
    with pytest.raises(QueueError, match=f"job {NAME}"):
        stored(connection, FUNCTION, kwargs=wrong).perform()


def test_positional_arguments_and_an_instance_are_refused(connection: redis.Redis) -> None:
    for data in ([FUNCTION, None, [SCENE_ID, 7], {}], [FUNCTION, "text", [], KWARGS], [FUNCTION, None, [], [1]]):
        job = stored(connection, FUNCTION)
        job.data = JSONSerializer.dumps(data)
        with pytest.raises(QueueError):
            job.perform()


def test_callbacks_and_webhooks_are_dropped_whoever_set_them(connection: redis.Redis) -> None:
    evil = Callback("os.system")
    job = stored(connection, FUNCTION, on_success=evil, on_failure=evil, on_stopped=evil)
    connection.hset(job.key, "webhooks", '[{"url": "http://127.0.0.1:1/", "job_status": "finished"}]')
    job.refresh()
    assert job.success_callback is job.failure_callback is job.stopped_callback is None
    assert job.webhooks == []


def test_pickled_data_are_never_unpickled(connection: redis.Redis, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "owned",))

    job = stored(connection, FUNCTION)
    connection.hset(job.key, "data", zlib.compress(pickle.dumps(Evil())))
    job.refresh()
    with pytest.raises(Exception, match=r"^$|deserial|decode"):
        job.perform()
    assert not (tmp_path / "owned").exists()


def test_a_refused_job_does_not_run(connection: redis.Redis) -> None:
    job = stored(connection, FUNCTION)
    job.refuse("its worker died")
    with pytest.raises(IncompleteError, match="its worker died"):
        job.perform()


# -------------------------------------------------------------------------------------------------------- reconcile


def queued(connection: redis.Redis) -> list[str]:
    return open_queue(connection).get_job_ids()


def test_everything_missing_is_queued_once(connection: redis.Redis, store: Store, scene: SceneStore) -> None:
    samples.commit(scene, 3, samples.outputs(scene, 3))
    assert reconcile(store, connection) == 9
    assert queued(connection) == [job_name(scene.scene_id, job) for job in range(10) if job != 3]
    assert reconcile(store, connection) == 0
    job = RenderJob.fetch(queued(connection)[0], connection=connection, serializer=JSONSerializer)
    assert (job.func_name, job.arguments().scene_id, job.result_ttl) == (FUNCTION, scene.scene_id, 0)


def test_a_job_with_a_heartbeat_or_a_recent_failure_is_left_alone(
    connection: redis.Redis, store: Store, scene: SceneStore
) -> None:
    queue.beat(connection, "worker", "host", job_name(scene.scene_id, 0), ttl_s=60)
    queue.record_failure(connection, job_name(scene.scene_id, 1), "it is broken")
    assert reconcile(store, connection) == 8
    status = queue_status(connection)
    assert (status.queued, status.running, status.workers) == (8, 1, 1)
    assert status.failed == {job_name(scene.scene_id, 1): "it is broken"}
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


def test_the_permissions_that_the_documentation_names_suffice(
    connection: redis.Redis, server: EmbeddedRedis, store: Store, scene: SceneStore
) -> None:
    rules = ["~rq:*", "~alive:*", "&rq:*", "+@read", "+@write", "+@transaction", "+@connection", "+@pubsub",
             "+@blocking", "+@scripting", "-@dangerous", "+info", "+client|list", "+client|setname"]  # fmt: skip
    connection.execute_command("ACL", "SETUSER", "worker", "on", ">secret", *rules)
    url = server.url.replace("unix://", "unix://worker:secret@")
    with connect(url) as limited:
        assert reconcile(store, limited) == 10
        queue.beat(limited, "worker", "host", "job", ttl_s=60)
        assert queue_status(limited).queued == 10
        queue.bury(limited, "worker")
        assert queue.hosts(limited) == set()
        with pytest.raises(redis.exceptions.NoPermissionError):
            limited.flushall()
