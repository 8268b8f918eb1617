"""Workers and Redis are killed, hang and lose their memory; the plan completes, each slot once, bit for bit.

Each happens once here; `test_soak` does all of it many times, at random.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue.connection import connect
from photonfarm.queue.failures import read_kept_failures
from photonfarm.queue.job import TRIES
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.renderer.worker.settings import GRACE_S
from photonfarm.store import SceneReader, SceneStore, Store

Bytes = Callable[[SceneStore], dict[str, bytes]]
Planner = Callable[..., SceneStore]
Starter = Callable[..., subprocess.Popen[bytes]]

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """What workers say."""
    return tmp_path / "log"


@pytest.fixture
def start(analytic: ModuleType, redis_server: EmbeddedRedis, log: Path) -> Iterator[Starter]:
    """Starts a worker of a scene whose halves take so many seconds each; it is ended with the test."""
    with contextlib.ExitStack() as stack:

        def started(scene: SceneStore, pause_s: float, **settings: object) -> subprocess.Popen[bytes]:
            root, child = scene.folder.parent.parent, analytic.command(pause_s)
            process = stack.enter_context(analytic.start_worker(root, redis_server.url, child, log, **settings))
            stack.callback(process.kill)
            return process

        yield started


@pytest.fixture
def child_at_work(analytic: ModuleType, redis_server: EmbeddedRedis) -> Callable[[subprocess.Popen[bytes]], int]:
    """The child of a worker, once it has a job in hand."""

    def wait(running: subprocess.Popen[bytes]) -> int:
        analytic.wait_for(lambda: queue_status(connect(redis_server.url)).running == 1, 60)
        found: int = analytic.child_of(running)
        return found

    return wait


def assert_complete(scene: SceneStore, stored: dict[str, bytes], clean: dict[str, bytes]) -> None:
    assert scene.missing_jobs() == []
    assert stored.keys() == clean.keys()
    assert [name for name in clean if stored[name] != clean[name]] == []
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    rows = reader.refresh()
    assert rows.size == scene.progress().planned_samples
    keys = {scene.plans()[0].rows.sample_key[row].tobytes() for row in rows}
    assert len(keys) == rows.size
    assert all(np.isfinite(reader.read(int(row)).radiance).all() for row in rows)


def test_a_killed_child_is_replaced_its_job_freed_at_once_and_no_bit_is_another(
    planned: Planner, clean_bytes: Callable[[int], dict[str, bytes]], stored_bytes: Bytes, start: Starter, child_at_work
) -> None:
    """The heartbeat would last a minute; the successor takes the job over in the time of a start."""
    scene = planned(4)
    running = start(scene, 0.1, until_complete=True, heartbeat_ttl_s=60.0)
    os.kill(child_at_work(running), signal.SIGKILL)
    assert running.wait(30) == 0
    Store(scene.folder.parent.parent).sweep(stray_age_s=0)
    assert_complete(scene, stored_bytes(scene), clean_bytes(4))
    assert list(scene.storage.local("tmp").iterdir()) == []


def test_a_redis_that_dies_and_comes_back_empty_delays_and_loses_nothing(
    analytic: ModuleType,
    planned: Planner,
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Bytes,
    redis_server: EmbeddedRedis,
    start: Starter,
    log: Path,
) -> None:
    scene = planned(6)
    running = start(scene, 0.1, until_complete=True)
    analytic.wait_for(lambda: len(scene.committed_jobs()) >= 2)
    assert redis_server.pid is not None
    os.kill(redis_server.pid, signal.SIGKILL)
    analytic.wait_for(lambda: "Redis" in log.read_text())
    assert running.poll() is None
    for folder in redis_server.folder.glob("appendonlydir"):
        folder.rename(redis_server.folder.with_name("forgotten"))
    redis_server.keep_running()
    assert running.wait(60) == 0
    assert_complete(scene, stored_bytes(scene), clean_bytes(6))


def test_a_redis_that_forgets_the_job_in_hand_fails_no_job_and_costs_no_worker(
    analytic: ModuleType, planned: Planner, redis_server: EmbeddedRedis, start: Starter, log: Path, child_at_work
) -> None:
    scene, connection = planned(2), connect(redis_server.url)
    running = start(scene, 0.3)
    child = child_at_work(running)
    for committed in range(2):
        connection.flushall()
        analytic.wait_for(lambda so_far=committed: len(scene.committed_jobs()) > so_far, 60)
    assert analytic.child_of(running) == child
    assert queue_status(connection).failed == {}
    running.terminate()
    assert running.wait(20) == 0
    assert "failed" not in log.read_text()
    assert "starting again" not in log.read_text()


@pytest.mark.parametrize("pause_s", [0.2, pytest.param(60.0, marks=pytest.mark.slow)])
def test_a_child_ends_soon_after_its_supervisor_and_finishes_a_short_job_before(
    analytic: ModuleType, planned: Planner, start: Starter, log: Path, child_at_work, pause_s: float
) -> None:
    scene = planned(8)
    running = start(scene, pause_s)
    child, done = child_at_work(running), len(scene.committed_jobs())
    running.kill()
    analytic.wait_for(lambda: not Path(f"/proc/{child}").exists(), GRACE_S + 4)
    assert "Traceback" not in log.read_text()
    if pause_s < GRACE_S:
        assert done + 1 <= len(scene.committed_jobs()) <= done + 2


def test_sigterm_lets_the_job_at_hand_be_finished(
    planned: Planner, redis_server: EmbeddedRedis, start: Starter, child_at_work
) -> None:
    scene = planned(8)
    running = start(scene, 0.2)
    child_at_work(running)
    done = len(scene.committed_jobs())
    running.send_signal(signal.SIGTERM)
    assert running.wait(20) == 0
    assert done + 1 <= len(scene.committed_jobs()) <= done + 2
    status = queue_status(connect(redis_server.url))
    assert (status.running, status.workers) == (0, 0)


@pytest.mark.parametrize("is_told_twice", [False, True])
def test_a_job_that_outlasts_the_grace_or_a_second_signal_is_killed_and_free_at_once(
    planned: Planner, redis_server: EmbeddedRedis, start: Starter, log: Path, child_at_work, is_told_twice: bool
) -> None:
    """The start that was cut short does not count towards those after which a job is given up."""
    scene = planned(2)
    running = start(scene, 60, heartbeat_ttl_s=60.0)
    child, told = child_at_work(running), time.monotonic()
    running.send_signal(signal.SIGTERM)
    if is_told_twice:
        time.sleep(0.3)
        running.send_signal(signal.SIGINT)
    assert running.wait(GRACE_S + 4) == 0
    assert (time.monotonic() - told > GRACE_S - 0.5) != is_told_twice
    assert not Path(f"/proc/{child}").exists()
    assert scene.committed_jobs() == set()
    connection = connect(redis_server.url)
    status = queue_status(connection)
    assert (status.running, status.workers, status.failed) == (0, 0, {})
    jobs = open_queue(connection)
    assert {jobs.fetch_job(name).retries_left for name in jobs.job_ids} == {TRIES - 1}
    said = log.read_text()
    assert said.count("stopping; a job in hand that takes longer than 5 s will be rendered again") == 1
    assert "Traceback" not in said


def test_a_job_that_hangs_is_ended_at_the_deadline_and_where_it_hung_is_told(
    analytic: ModuleType, planned: Planner, start: Starter, log: Path
) -> None:
    scene = planned(1)
    running = start(scene, 60, deadline_s=1.0)
    store = Store(scene.folder.parent.parent)
    analytic.wait_for(lambda: read_kept_failures(store))
    analytic.wait_for(lambda: "starting again" in log.read_text())
    running.send_signal(signal.SIGTERM)
    running.wait(20)
    told = log.read_text()
    assert f"job {scene.scene_id}-0 took longer than --deadline 1 s and was ended, while in\n" in told
    assert "in render_half" in told
    assert "Timeout" not in told
    assert len(told.splitlines()) <= 12 * told.count("starting again") + 3, "its own stack, and of that the innermost"


@pytest.mark.slow
def test_a_job_that_ends_its_worker_again_and_again_is_set_aside(
    planned: Planner, redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(1)
    assert start(scene, 60, deadline_s=0.5, until_complete=True, steady_s=0.1).wait(120) == 7
    failures = queue_status(connect(redis_server.url)).failed.values()
    assert [failure.times for failure in failures] == [TRIES] * scene.jobs()
    assert all("took longer than --deadline 0.5 s and was ended" in failure.reason for failure in failures)
