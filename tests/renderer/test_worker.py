"""The worker as a whole: real queue, real store, real processes; only the scene is analytic."""

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from rq.job import Callback, Job
from rq.serializers import JSONSerializer

from photonfarm.renderer.worker import check, run_worker
from photonfarm.shared import queue
from photonfarm.shared.errors import BackendError, IncompleteError, QueueError, StoreError
from photonfarm.shared.plan import Request
from photonfarm.shared.queue import connect, open_queue, queue_status
from photonfarm.shared.redis_server import EmbeddedRedis
from photonfarm.shared.store import SceneStore, Store, store_status


@pytest.fixture(scope="module")
def analytic() -> ModuleType:
    path = Path(__file__).parents[1] / "faults/analytic_scene.py"
    spec = importlib.util.spec_from_file_location("analytic_scene_of_worker", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def server(tmp_path: Path) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path / "redis") as running:
        yield running


@pytest.fixture
def scene(analytic: ModuleType, tmp_path: Path) -> SceneStore:
    """Two jobs of three samples."""
    store = Store(tmp_path / "store", create=True)
    return store.scene(store.plan(analytic.small_spec(), Request(modifications=6), shard_rows=3).scene_id)


QUICK = {"until_complete": True, "idle_s": 1, "heartbeat_ttl_s": 2.0}


def test_a_worker_fills_an_empty_queue_from_the_store_and_stops_when_nothing_is_missing(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    run_worker(tmp_path / "store", server.url, name="ada", child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []
    assert scene.has_base()
    assert {scene.marker(job)["figures"]["worker"] for job in range(2)} == {"ada"}
    status = queue_status(connect(server.url))
    assert (status.queued, status.running, status.failed, status.workers) == (0, 0, {}, 0)
    assert store_status(Store(tmp_path / "store"))[0].core_s > 0
    assert not list(connect(server.url).scan_iter(f"*{scene.scene_id}*")), "a done job leaves nothing in Redis"


@pytest.mark.parametrize("limit", [{"max_jobs": 1}, {"max_rss_bytes": 1}])
def test_a_child_is_replaced_after_so_many_jobs_or_bytes(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path, limit: dict[str, int]
) -> None:
    starts = tmp_path / "starts"
    code = "import sys, runpy; open(sys.argv[1], 'a').write('x'); sys.argv = sys.argv[2:]; "
    code += "runpy.run_path(sys.argv[0], run_name='__main__')"
    child = (sys.executable, "-c", code, str(starts), *analytic.command()[1:])
    run_worker(tmp_path / "store", server.url, child=child, **QUICK, **limit)
    assert scene.missing_jobs() == []
    assert len(starts.read_text()) == 3


def test_a_scene_that_never_renders_ends_a_complete_run_with_its_reason(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    with pytest.raises(
        IncompleteError, match=r"2 jobs have failed; .*: half A of sample .* came out non-finite 3 times"
    ):
        run_worker(tmp_path / "store", server.url, child=analytic.command(0, "broken"), **QUICK)
    assert len(queue_status(connect(server.url)).failed) == 2
    assert queue.reconcile(Store(tmp_path / "store"), connect(server.url), retry_failed=True) == 2
    run_worker(tmp_path / "store", server.url, child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []


def test_a_machine_without_a_backend_ends_the_worker_and_fails_no_job(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    with pytest.raises(BackendError, match="no libLLVM was found; install LLVM 19"):
        run_worker(tmp_path / "store", server.url, child=analytic.command(0, "no backend"), **QUICK)
    assert queue_status(connect(server.url)).failed == {}


def test_a_worker_for_one_scene_leaves_the_others_of_the_store_alone(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    """The other scene's job, queued by someone else, cannot be stored: that scene's failure and not the worker's."""
    store = Store(tmp_path / "store")
    other = store.scene(store.plan(analytic.small_spec(points=17), Request(modifications=6), shard_rows=3).scene_id)
    other.storage.local("tmp").rmdir()
    other.storage.local("tmp").write_text("a file where the folder should be")
    queue.reconcile(store, connect(server.url), scene_id=other.scene_id, limit=1)
    run_worker(tmp_path / "store", server.url, child=analytic.command(), scene_id=scene.scene_id, **QUICK)
    assert scene.missing_jobs() == []
    assert other.missing_jobs() == [0, 1]
    assert list(queue_status(connect(server.url)).failed) == [f"{other.scene_id}-0"]


def test_strangers_in_the_queue_are_refused_and_ours_go_on(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    connection, owned = connect(server.url), tmp_path / "owned"
    stranger = open_queue(connection)
    stranger.job_class = Job
    touch = Callback("os.system")
    for i, function in enumerate(("os.system", "photonfarm.renderer.jobs.render_shard", "os.system")):
        stranger.enqueue(function, kwargs={"command": f"touch {owned}"}, job_id=f"evil-{i}", on_failure=touch)
    poison = stranger.enqueue("os.system", job_id="evil-pickle")
    connection.hset(poison.key, "data", b"\x80\x04cos\nsystem\n(Vtouch\ntR.")
    run_worker(tmp_path / "store", server.url, child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []
    assert not owned.exists()
    failed = stranger.failed_job_registry.get_job_ids(cleanup=False)
    assert set(failed) == {"evil-0", "evil-1", "evil-2", "evil-pickle"}
    why = Job.fetch("evil-0", connection=connection, serializer=JSONSerializer).latest_result().exc_string
    assert "'os.system' is refused" in why


def test_no_redis_is_told_before_anything_is_started(analytic: ModuleType, scene: SceneStore, tmp_path: Path) -> None:
    with pytest.raises(QueueError, match=r"no Redis at redis://127\.0\.0\.1:1/0"):
        run_worker(tmp_path / "store", "redis://127.0.0.1:1/0", child=analytic.command())


def test_a_store_that_cannot_be_opened_is_told_before_anything_is_started(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="file/store"):
        run_worker(tmp_path / "file/store", "redis://127.0.0.1:1/0")


def test_a_store_that_refuses_a_commit_ends_the_worker_and_fails_no_job(
    analytic: ModuleType, scene: SceneStore, server: EmbeddedRedis, tmp_path: Path
) -> None:
    scene.write_base(*analytic.AnalyticScene(analytic.small_spec()).base())
    scene.storage.local("tmp").rmdir()
    scene.storage.local("tmp").write_text("a file where the folder should be")
    with pytest.raises(StoreError, match="cannot commit job"):
        run_worker(tmp_path / "store", server.url, child=analytic.command(), **QUICK)
    assert queue_status(connect(server.url)).failed == {}
    scene.storage.local("tmp").unlink()
    run_worker(tmp_path / "store", server.url, child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []


def test_whether_a_worker_of_this_machine_is_alive_can_be_asked(server: EmbeddedRedis) -> None:
    connection = connect(server.url)
    queue.beat(connection, "far", "another-machine", None, ttl_s=60)
    with pytest.raises(IncompleteError, match=r"no worker of .* is alive"):
        check(server.url)
    queue.beat(connection, "near", os.uname().nodename, None, ttl_s=60)
    check(server.url)
