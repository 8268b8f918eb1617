"""The worker as a whole: real queue, real store, real processes; only the scene is analytic."""

import json
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import queue_samples

from photonfarm.cli.farm_verbs import status
from photonfarm.core.errors import BackendError, IncompleteError, QueueError, StoreError
from photonfarm.core.processes import Stop
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.failures import read_kept_failures
from photonfarm.queue.job import TRIES, Share, job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import queue_status
from photonfarm.queue.workers import Activity, WorkerReport, read_workers
from photonfarm.renderer.worker.settings import JOB_ENDED, JOB_IN_HAND, WorkerSettings
from photonfarm.renderer.worker.source import QueueSource, ShareSource
from photonfarm.renderer.worker.worker import ChildOutput, check, ending, render_job, run_worker
from photonfarm.scene.spec import Source
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scene(analytic: ModuleType, tmp_path: Path) -> SceneStore:
    """Two jobs of three samples."""
    store = Store(tmp_path / "store", create=True)
    return store.scene(store.plan(analytic.small_spec(), Request(modifications=6), shard_rows=3).scene_id)


QUICK = {"until_complete": True, "idle_s": 1, "heartbeat_ttl_s": 2.0, "reserve_bytes": 0}


@pytest.mark.parametrize(("limit", "quiet"), [("max_jobs", False), ("max_rss_bytes", True)])
def test_a_child_is_replaced_after_so_many_jobs_or_bytes_and_what_all_have_done_is_said_at_the_end(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path, limit: str, quiet: bool
) -> None:
    said: list[str] = []
    starts = tmp_path / "starts"
    code = "import sys, runpy; open(sys.argv[1], 'a').write('x'); sys.argv = sys.argv[2:]; "
    code += "runpy.run_path(sys.argv[0], run_name='__main__')"
    child = (sys.executable, "-c", code, str(starts), *analytic.command()[1:])
    how = {**QUICK, "name": "ada", "report": said.append, "quiet": quiet, limit: 1}
    run_worker(tmp_path / "store", redis_server.url, child=child, **how)
    assert scene.missing_jobs() == []
    assert len(starts.read_text()) == 3
    assert said == ([] if quiet else ["worker ada: ended: 2 jobs done"])


def test_a_scene_that_never_renders_ends_a_complete_run_is_set_aside_at_last_and_can_be_repeated(
    analytic: ModuleType,
    scene: SceneStore,
    redis_server: EmbeddedRedis,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    connection, root, names = (
        connect(redis_server.url),
        tmp_path / "store",
        [job_name(scene.scene_id, j) for j in range(2)],
    )
    with pytest.raises(IncompleteError):
        run_worker(root, redis_server.url, child=analytic.command(0, "broken"), **QUICK)
    failed = queue_status(connection).failed
    assert {name: failure.times for name, failure in failed.items()} == dict.fromkeys(names, TRIES)
    assert read_kept_failures(Store(root)) == failed
    command = f"photonfarm work --store {root} --scene {scene.scene_id} --job 0"
    assert command in capfd.readouterr().err

    status.callback(root, redis_server.url, as_json=True)
    (cause,) = json.loads(capfd.readouterr().out)["queue"]["failures"]
    assert cause["cause"].startswith("IncompleteError: half A of sample … ")
    assert (cause["failed"], cause["set_aside"]) == (2, 2)
    assert [job["command"] for job in cause["jobs"]] == [command, command[:-1] + "1"]
    status.callback(root, redis_server.url, as_json=False)
    shown = capfd.readouterr().out
    assert f"2 jobs failed, 2 of them set aside until `photonfarm submit --retry`: {cause['cause']}" in shown
    assert command in shown

    analytic.AnalyticScene.broken = True
    try:
        with pytest.raises(IncompleteError):
            render_job(root, scene.scene_id, 0, load=analytic.AnalyticScene.load)
    finally:
        analytic.AnalyticScene.broken = False
    assert render_job(root, scene.scene_id, 0, load=analytic.AnalyticScene.load)[0]
    assert not render_job(root, scene.scene_id, 0, load=analytic.AnalyticScene.load)[0]
    status.callback(root, redis_server.url, as_json=True)
    (cause,) = json.loads(capfd.readouterr().out)["queue"]["failures"]
    assert [job["name"] for job in cause["jobs"]] == names[1:], "what has been committed since has not failed"
    assert reconcile(Store(root), connection, retry=True) == 1


@pytest.mark.parametrize(
    ("scene_id", "job"),
    [("../../etc", 0), (None, 2)],
)
def test_a_job_that_is_not_planned_cannot_be_rendered(
    scene: SceneStore, tmp_path: Path, scene_id: str | None, job: int
) -> None:
    with pytest.raises(StoreError):
        render_job(tmp_path / "store", scene_id or scene.scene_id, job)


def test_a_machine_without_a_backend_ends_the_worker_and_fails_no_job(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    with pytest.raises(BackendError):
        run_worker(tmp_path / "store", redis_server.url, child=analytic.command(0, "no backend"), **QUICK)
    assert queue_status(connect(redis_server.url)).failed == {}


def test_a_worker_for_one_scene_leaves_the_others_of_the_store_alone(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    store = Store(tmp_path / "store")
    other = store.scene(store.plan(analytic.small_spec(points=17), Request(modifications=6), shard_rows=3).scene_id)
    reconcile(store, connect(redis_server.url), scene_id=other.scene_id)
    run_worker(tmp_path / "store", redis_server.url, child=analytic.command(), scene_id=scene.scene_id, **QUICK)
    assert scene.missing_jobs() == []
    assert other.missing_jobs() == [0, 1]
    status = queue_status(connect(redis_server.url))
    assert (status.queued, status.failed) == (2, {})


def test_a_scene_whose_files_are_not_here_is_left_to_others_and_keeps_nothing_else_from_being_rendered(
    analytic: ModuleType,
    scene: SceneStore,
    redis_server: EmbeddedRedis,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    store, connection = Store(tmp_path / "store"), connect(redis_server.url)
    elsewhere = analytic.small_spec().model_copy(update={"scene": Source(file="gone.xml")})
    other = store.scene(store.plan(elsewhere, Request(modifications=9), shard_rows=3).scene_id)
    for told in (other, scene):
        reconcile(store, connection, scene_id=told.scene_id)
    with pytest.raises(BackendError):
        run_worker(tmp_path / "store", redis_server.url, child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []
    assert other.missing_jobs() == [0, 1, 2]
    status = queue_status(connection)
    assert (status.queued, status.failed) == (3, {}), "for workers that have the files"
    said = capfd.readouterr().err
    assert said.count("takes no jobs of scene") == 1
    assert "Traceback" not in said

    assert queue_status(connection).skipped == {}, "said while it works only"


def test_what_a_worker_does_is_told_while_it_does_it_and_not_after(
    scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{QueueSource.__module__}.REPORT_S", 0.02)
    connection, store = connect(redis_server.url), Store(tmp_path / "store")
    reconcile(store, connection)
    settings = WorkerSettings(store=str(store.root), redis_url=redis_server.url, name="ada", idle_s=1)
    source = QueueSource(settings, store, Stop())
    with source.open():
        job = source.take(None, {})
        name = job_name(*job)
        source.tell_doing(Activity("renders samples", 3, 8, name))
        wanted = {"ada": Activity("renders samples", 3, 8, name)}
        assert _once(lambda: queue_status(connection).activities == wanted)
        connection.flushall()
        assert _once(lambda: queue_status(connection).running == 1), "what Redis has lost is told again"
        source.end(name, "done", "")
        assert _once(lambda: not queue_status(connection).activities)
        assert source.take("the disk is full", {}) is None
        assert _once(lambda: queue_status(connection).paused == {"ada": "the disk is full"})


def test_a_share_of_a_scene_that_is_not_there_yet_takes_no_job_of_others(scene: SceneStore) -> None:
    store = Store(scene.folder.parent.parent)
    share, absent = Share(number=0, of=1), "0" * 32
    settings = WorkerSettings(store=str(store.root), share=share, scene_ids=(absent,), name="ada")
    assert ShareSource(settings, store, share).take(None, {}) is None
    both = settings.model_copy(update={"scene_ids": (absent, scene.scene_id)})
    assert ShareSource(both, store, share).take(None, {}) is not None


def _once(look: Callable[[], bool], seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while not (found := look()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


def test_a_worker_fills_an_empty_queue_from_the_store_and_goes_by_another_name_where_its_own_is_taken(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    connection, said = connect(redis_server.url), []
    queue_samples.told(connection, "ada", WorkerReport(host="another-machine", process=7))
    run_worker(tmp_path / "store", redis_server.url, name="ada", child=analytic.command(), report=said.append, **QUICK)
    assert scene.missing_jobs() == []
    assert scene.has_base()
    assert {scene.marker(job)["figures"]["worker"] for job in range(2)} == {"ada-2"}
    assert "ada-2" in said[0]
    assert said[1] == "worker ada-2: ended: 2 jobs done"
    assert list(read_workers(connection)) == ["ada"]
    status = queue_status(connection)
    assert (status.queued, status.running, status.failed, status.workers) == (0, 0, {}, 1)
    assert not list(connection.scan_iter(f"*{scene.scene_id}*")), "a done job leaves nothing in Redis"


def test_no_redis_is_told_before_anything_is_started(analytic: ModuleType, scene: SceneStore, tmp_path: Path) -> None:
    with pytest.raises(QueueError):
        run_worker(tmp_path / "store", "redis://127.0.0.1:1/0", child=analytic.command())


def test_a_redis_that_refuses_for_good_ends_a_worker_with_a_sentence(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    """Its user loses a right while it works; a new child would meet the same refusal, for ever."""
    admin = connect(redis_server.url)
    admin.acl_setuser("ada", enabled=True, passwords=["+secret"], keys=["*"], commands=["+@all"])
    ended: list[Exception] = []

    def work() -> None:
        try:
            run_worker(
                tmp_path / "store",
                redis_server.url.replace("://", "://ada:secret@"),
                child=analytic.command(),
                idle_s=1,
                reserve_bytes=0,
            )
        except QueueError as error:
            ended.append(error)

    worker = threading.Thread(target=work)
    worker.start()
    analytic.wait_for(lambda: not scene.missing_jobs(), 60)
    admin.acl_setuser("ada", commands=["-lrange"])
    worker.join(60)
    assert "docker/redis.sh" in str(ended[0])
    assert "secret" not in str(ended[0])


def test_a_store_that_refuses_a_commit_ends_the_worker_and_fails_no_job(
    analytic: ModuleType, scene: SceneStore, redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    scene.write_base(*analytic.AnalyticScene(analytic.small_spec()).base())
    scene.storage.local("tmp").rmdir()
    scene.storage.local("tmp").write_text("a file where the folder should be")
    with pytest.raises(StoreError):
        run_worker(tmp_path / "store", redis_server.url, child=analytic.command(), **QUICK)
    assert queue_status(connect(redis_server.url)).failed == {}
    scene.storage.local("tmp").unlink()
    run_worker(tmp_path / "store", redis_server.url, child=analytic.command(), **QUICK)
    assert scene.missing_jobs() == []


def test_whether_a_worker_of_this_machine_is_alive_can_be_asked(redis_server: EmbeddedRedis) -> None:
    connection = connect(redis_server.url)
    queue_samples.told(connection, "far", WorkerReport(host="another-machine", process=7))
    with pytest.raises(IncompleteError):
        check(redis_server.url)
    queue_samples.told(connection, "near", WorkerReport())
    check(redis_server.url)


@pytest.mark.parametrize("code", [1, -11])
def test_a_job_is_overdue_whether_or_not_the_dump_of_its_stacks_crashed(code: int) -> None:
    """faulthandler may crash while it dumps the stack of another thread, which runs on."""
    stacks = ["Thread 0x1 (most recent call first):\n  File a, line 1 in beat", "Thread 0x2\n  File b, line 2 in job"]
    written = f"{JOB_IN_HAND}some-3\nTimeout (0:00:04)!\n" + "\n".join(stacks if code == 1 else stacks[:1])
    output = ChildOutput.of(written)
    assert (output.timed_out, output.in_hand) == (True, "some-3")
    told = ending(code, output, 4.0)
    assert told.startswith("job some-3 took longer than --deadline 4 s and was ended")
    assert ("line 2 in job" in told, "line 1" in told) == (code == 1, False)


def test_a_child_that_ends_over_another_timeout_says_so() -> None:
    said = "Redis failed: Timeout (30 s) reading"
    assert ending(5, ChildOutput.of(f"{JOB_IN_HAND}some-3\n{JOB_ENDED}done\n{said}\n"), 4.0) == said
