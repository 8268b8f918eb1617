"""Workers and Redis are killed, hang and lose their memory; the plan completes, each slot once, bit for bit."""

import contextlib
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue import TRIES, connect, queue_status, read_kept_failures, reconcile
from photonfarm.queue.rq_adapter import open_queue
from photonfarm.renderer.worker.settings import GRACE_S
from photonfarm.store import SceneReader, SceneStore, Store

Bytes = Callable[[SceneStore], dict[str, bytes]]
Starter = Callable[..., subprocess.Popen[bytes]]

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")


@pytest.fixture
def start(analytic: ModuleType) -> Iterator[Starter]:
    """`analytic_scene.start_worker`, whose supervisors are ended with the test."""
    with contextlib.ExitStack() as stack:

        def started(*args: object, **settings: object) -> subprocess.Popen[bytes]:
            process = stack.enter_context(analytic.start_worker(*args, **settings))
            stack.callback(process.kill)
            return process

        yield started


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


def test_two_workers_under_a_hail_of_kills_complete_the_plan_bit_for_bit(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Bytes,
    redis_server: EmbeddedRedis,
    start: Starter,
) -> None:
    scene = planned(40)
    root, rng = scene.folder.parent.parent, random.Random(0)
    reconcile(Store(root), connect(redis_server.url))
    workers = [
        start(root, redis_server.url, analytic.command(0.08), until_complete=True, name=f"worker-{i}") for i in range(2)
    ]
    kills = 0
    while any(w.poll() is None for w in workers) and kills < 6:
        time.sleep(rng.uniform(0.9, 1.6))
        child = analytic.child_of(rng.choice(workers))
        if child is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
                kills += 1
        if kills == 3:
            connect(redis_server.url).flushall()
    assert [w.wait(60) for w in workers] == [0, 0]
    assert kills >= 4
    Store(root).sweep(stray_age_s=0)
    assert_complete(scene, stored_bytes(scene), clean_bytes(40))
    assert list(scene.storage.local("tmp").iterdir()) == []


def test_a_redis_that_dies_and_comes_back_empty_delays_and_loses_nothing(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Bytes,
    tmp_path: Path,
    start: Starter,
) -> None:
    scene = planned(10)
    root = scene.folder.parent.parent
    with EmbeddedRedis(tmp_path / "first") as server:
        running = start(root, server.url, analytic.command(0.2), until_complete=True)
        analytic.wait_for(lambda: len(scene.committed_jobs()) >= 2)
        os.kill(server.pid, signal.SIGKILL)
        time.sleep(4)  # so long that the worker asks, however slow the machine is
        assert running.poll() is None
    for file in (tmp_path / "first").rglob("*.aof"):
        file.unlink()
    (tmp_path / "first/appendonlydir").rename(tmp_path / "forgotten")
    with EmbeddedRedis(tmp_path / "first"):
        assert running.wait(60) == 0
    assert b"Redis" in running.stderr.read()
    assert_complete(scene, stored_bytes(scene), clean_bytes(10))


def test_a_redis_that_forgets_the_job_in_hand_fails_no_job_and_costs_no_worker(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(3)
    connection = connect(redis_server.url)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(0.3))
    analytic.wait_for(lambda: queue_status(connection).running == 1, 60)
    child = analytic.child_of(running)
    for committed in range(3):
        connection.flushall()
        analytic.wait_for(lambda so_far=committed: len(scene.committed_jobs()) > so_far, 60)
    assert analytic.child_of(running) == child
    assert queue_status(connection).failed == {}
    running.terminate()
    assert running.wait(20) == 0
    said = running.stderr.read().decode()
    assert "failed" not in said
    assert "starting again" not in said


def test_a_killed_child_is_replaced_and_its_job_freed_at_once(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    """The heartbeat would last a minute; the successor takes the job over in the time of a start."""
    scene = planned(2)
    running = start(
        scene.folder.parent.parent, redis_server.url, analytic.command(0.1), until_complete=True, heartbeat_ttl_s=60.0
    )
    connection = connect(redis_server.url)
    analytic.wait_for(lambda: queue_status(connection).running == 1)
    os.kill(analytic.child_of(running), signal.SIGKILL)
    assert running.wait(30) == 0
    assert scene.missing_jobs() == []


def test_a_child_ends_with_its_supervisor_after_the_job_at_hand(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(8)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(0.2))
    analytic.wait_for(lambda: queue_status(connect(redis_server.url)).running == 1)
    child = analytic.child_of(running)
    done = len(scene.committed_jobs())
    running.kill()
    analytic.wait_for(lambda: not Path(f"/proc/{child}").exists())
    assert done + 1 <= len(scene.committed_jobs()) <= done + 2


def test_sigterm_lets_the_job_at_hand_be_finished(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(8)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(0.2))
    connection = connect(redis_server.url)
    analytic.wait_for(lambda: queue_status(connection).running == 1)
    done = len(scene.committed_jobs())
    running.send_signal(signal.SIGTERM)
    assert running.wait(20) == 0
    assert done + 1 <= len(scene.committed_jobs()) <= done + 2
    status = queue_status(connection)
    assert (status.running, status.workers) == (0, 0)


def test_a_job_that_outlasts_the_grace_is_killed_and_free_at_once(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    """The start that was cut short does not count towards those after which a job is given up."""
    scene = planned(2)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(60), heartbeat_ttl_s=60.0)
    connection = connect(redis_server.url)
    analytic.wait_for(lambda: queue_status(connection).running == 1)
    child, told = analytic.child_of(running), time.monotonic()
    running.send_signal(signal.SIGTERM)
    assert running.wait(9) == 0
    assert time.monotonic() - told > GRACE_S - 0.5
    assert not Path(f"/proc/{child}").exists()
    assert scene.committed_jobs() == set()
    status = queue_status(connection)
    assert (status.running, status.workers, status.failed) == (0, 0, {})
    jobs = open_queue(connection)
    assert {jobs.fetch_job(name).retries_left for name in jobs.job_ids} == {TRIES - 1}
    said = running.stderr.read().decode()
    assert said.count("stopping; a job in hand that takes longer than 5 s will be rendered again") == 1
    assert "Traceback" not in said


def test_a_child_in_a_long_job_ends_soon_after_its_supervisor(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(2)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(60))
    analytic.wait_for(lambda: queue_status(connect(redis_server.url)).running == 1)
    child = analytic.child_of(running)
    running.kill()
    analytic.wait_for(lambda: not Path(f"/proc/{child}").exists(), 9)
    assert "Traceback" not in running.stderr.read().decode()


def test_a_second_signal_ends_the_worker_at_once(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(2)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(30))
    analytic.wait_for(lambda: queue_status(connect(redis_server.url)).running == 1)
    running.send_signal(signal.SIGINT)
    time.sleep(0.3)
    running.send_signal(signal.SIGINT)
    assert running.wait(5) == 0
    assert scene.committed_jobs() == set()


def test_a_job_that_hangs_is_ended_at_the_deadline_and_where_it_hung_is_told(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(1)
    running = start(scene.folder.parent.parent, redis_server.url, analytic.command(60), deadline_s=4.0)
    store = Store(scene.folder.parent.parent)
    analytic.wait_for(lambda: sum(failure.times for failure in read_kept_failures(store).values()) >= 2)
    running.send_signal(signal.SIGTERM)
    running.wait(20)
    told = running.stderr.read().decode()
    job = f"{scene.scene_id}-0"
    assert f"job {job} took longer than --deadline 4 s and was ended, while in\n" in told
    assert "in render_half" in told
    assert "starting again" in told
    assert "Timeout" not in told
    assert len(told.splitlines()) <= 12 * told.count("starting again") + 3, "its own stack, and of that the innermost"


@pytest.mark.slow
def test_a_job_that_ends_its_worker_again_and_again_is_set_aside(
    analytic: ModuleType, planned: Callable[..., SceneStore], redis_server: EmbeddedRedis, start: Starter
) -> None:
    scene = planned(1)
    running = start(
        scene.folder.parent.parent,
        redis_server.url,
        analytic.command(60),
        deadline_s=0.5,
        until_complete=True,
        steady_s=0.1,
    )
    assert running.wait(120) == 7
    failed = queue_status(connect(redis_server.url)).failed
    assert len(failed) == scene.jobs()
    for failure in failed.values():
        assert "took longer than --deadline 0.5 s and was ended" in failure.reason
        assert failure.times == TRIES
