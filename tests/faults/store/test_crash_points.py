"""A writer is killed at every step of its work; nothing half-done is ever seen, and the next writer completes it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue.connection import connect
from photonfarm.queue.job import job_name
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.io.storage import AT_ONCE

COMMIT = """
import itertools, os, sys
from photonfarm.store import JobWriter, Store
from photonfarm.renderer.jobs.render import ShardRenderer
sys.path.append(sys.argv[1])
import analytic_scene as analytic

function, count, when = sys.argv[4], int(sys.argv[5]), sys.argv[6]
owner = JobWriter if function == "commit" else os
plain, numbers = getattr(owner, function), itertools.count(1)

def dying(*args, **kwargs):
    number = next(numbers)  # of this call; others may be made meanwhile, in other threads
    if number == count and when == "before":
        os.kill(os.getpid(), 9)
    result = plain(*args, **kwargs)
    if number == count:
        os.kill(os.getpid(), 9)
    return result

renderer = ShardRenderer(Store(sys.argv[2]), worker="doomed", load=analytic.AnalyticScene.load)
if sys.argv[3] != "base":
    Store(sys.argv[2]).scenes()[0].write_base(*analytic.AnalyticScene(analytic.small_spec()).base())
setattr(owner, function, dying)
if sys.argv[3] == "plan":
    from photonfarm.plan.request import Request
    Store(sys.argv[2]).plan(analytic.small_spec(), Request(modifications=9))
else:
    renderer.render(Store(sys.argv[2]).scene_ids()[0], 0)
"""

# A commit of this job writes 23 arrays, 8 at once, and the marker: a link each, once what it links is synced. Before it
# comes the announcement that the worker is at the job: a link, a sync of its bytes, and three of folders.
POINTS = {
    "after render, before the commit": ("commit", "commit", 1, "before"),
    "after the temporary files, before the first is synced": ("commit", "fdatasync", 2, "before"),
    "after the first temporary file is synced": ("commit", "fdatasync", 2, "after"),
    "in the middle, before a link": ("commit", "link", 6, "before"),
    "in the middle, after a link": ("commit", "link", 6, "after"),
    "after all files, before the folders are synced": ("commit", "fsync", 4, "before"),
    "before the marker": ("commit", "link", 25, "before"),
    "after the marker": ("commit", "link", 25, "after"),
    "while the base is written": ("base", "fsync", 3, "before"),
    "before the base gets its name": ("base", "rename", 1, "before"),
    "after the base has got its name": ("base", "rename", 1, "after"),
}


NAMED = {
    "after the temporary files, before the first is synced": range(AT_ONCE),
    "after the first temporary file is synced": range(AT_ONCE),
    "in the middle, before a link": range(4 + AT_ONCE),
    "in the middle, after a link": range(1, 5 + AT_ONCE),
    "after all files, before the folders are synced": range(23, 24),
    "before the marker": range(23, 24),
    "after the marker": range(23, 24),
}
"""How many files of the job may have their names by then; at all other points none has."""


def crash(analytic: ModuleType, store: Path, *point: object) -> None:
    command = [sys.executable, "-c", COMMIT, str(analytic.FOLDER), str(store), *map(str, point)]
    assert subprocess.run(command, timeout=60).returncode == -signal.SIGKILL


@pytest.mark.parametrize("where", POINTS)
def test_a_writer_killed_at_any_point_leaves_all_or_nothing(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
    where: str,
) -> None:
    scene = planned(1)
    root, before = scene.folder.parent.parent, stored_bytes(scene)
    crash(analytic, root, *POINTS[where])
    named = [name for name in stored_bytes(scene).keys() - before.keys() if name.startswith("plans/")]
    assert len(named) in NAMED.get(where, range(1))

    reader = SceneReader(root, scene.scene_id)
    assert reader.refresh().size == (2 if where == "after the marker" else 0)
    for row in reader.rows:
        reader.read(int(row))
    renderer = ShardRenderer(Store(root), worker="next", load=analytic.AnalyticScene.load)
    for job in scene.missing_jobs():
        renderer.render(scene.scene_id, job)
    assert stored_bytes(scene) == clean_bytes(1)
    Store(root).sweep(stray_age_s=0)
    assert list(scene.storage.local("tmp").iterdir()) == []


CHILD = """
import os, sys
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker import child as worker_child
sys.path.append(sys.argv[1])
import analytic_scene as analytic
plain = jobs.ShardRenderer.render

def dying(*args):
    if plain(*args):
        os.kill(os.getpid(), 9)

jobs.ShardRenderer.render = dying
sys.exit(worker_child.child(analytic.AnalyticScene.load))
"""


def kill_before_acknowledgement(analytic: ModuleType, root: Path, url: str) -> None:
    """A worker's child, with nobody who would start it again, dies once it has committed its first job."""
    settings = WorkerSettings(store=str(root), redis_url=url, name="doomed", heartbeat_ttl_s=1.0, reserve_bytes=0)
    command = [sys.executable, "-c", CHILD, str(analytic.FOLDER)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as child:
        child.stdin.write(settings.model_dump_json().encode() + b"\n")
        child.stdin.flush()  # and left open: its end would tell the child that its supervisor is gone
        assert child.wait(60) == -signal.SIGKILL


def files_of(scene: SceneStore) -> dict[str, tuple[bytes, int, int]]:
    """Every file of a scene, markers as well: its bytes, and which file it is, and since when."""
    files = [path for path in scene.folder.rglob("*") if path.is_file()]
    return {str(path): (path.read_bytes(), path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="the worker's child finds its memory through /proc")
@pytest.mark.parametrize("comes_again", [False, True], ids=["left in Redis", "given out again"])
def test_a_job_whose_worker_dies_before_redis_learns_of_its_end_stays_as_it_was_committed(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
    redis_server: EmbeddedRedis,
    comes_again: bool,
) -> None:
    """It may be given out again: who fills the queue reads the markers first, and the job may end in between."""
    scene = planned(2)
    root, connection = scene.folder.parent.parent, connect(redis_server.url)
    reconcile(Store(root), connection)
    kill_before_acknowledgement(analytic, root, redis_server.url)
    assert scene.committed_jobs() == {0}
    queue, name = open_queue(connection), job_name(scene.scene_id, 0)
    assert queue.started_job_registry.get_job_ids(cleanup=False) == [name], "RQ holds it to be running"
    committed = files_of(scene)
    if comes_again:
        connection.lpush(queue.key, name)

    with analytic.start_worker(root, redis_server.url, analytic.command(), name="next") as worker:
        try:
            analytic.wait_for(lambda: not (queue.job_ids or queue.started_job_registry.get_job_ids(cleanup=False)))
        finally:
            worker.terminate()
        told = worker.stderr.read().decode()
        assert worker.wait(20) == 0, told
    assert "failed" not in told
    assert {name: file for name, file in files_of(scene).items() if name in committed} == committed
    assert scene.marker(0)["figures"]["worker"] == "doomed"
    assert scene.marker(1)["figures"]["worker"] == "next"
    assert stored_bytes(scene) == clean_bytes(2)
    assert queue_status(connection).failed == {}


@pytest.mark.parametrize("point", [("fsync", 5, "before"), ("rename", 1, "before"), ("rename", 1, "after")])
def test_a_submitter_killed_at_any_point_leaves_a_whole_plan_or_none(
    analytic: ModuleType, planned: Callable[..., SceneStore], point: tuple[str, int, str]
) -> None:
    scene = planned(1)
    root = scene.folder.parent.parent
    crash(analytic, root, "plan", *point)
    result = Store(root).plan(analytic.small_spec(), Request(modifications=9))
    assert result.known + result.new == 9
    assert scene.progress().planned_samples == 4 + 8  # 4 of the plan before, of which the request names 1
    assert len(scene.plans()) == 2
    Store(root).sweep(stray_age_s=0)
    assert list(scene.storage.local("tmp").iterdir()) == []


def test_temporary_files_of_the_living_and_of_other_machines_are_left_alone(
    planned: Callable[..., SceneStore],
) -> None:
    scene = planned(1)
    mine = scene.storage.part()
    foreign = mine.with_name("another-machine-1-0-0.partial")
    namesake = mine.with_name(f"{os.uname().nodename}-2-0-4194999-0-0.partial")  # of host "…-2", or a container
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}-", "-4194999-"))  # no process has this number
    for path in (mine, foreign, namesake, dead):
        path.write_bytes(b"half a file")
    assert scene.storage.sweep(stray_age_s=0) == 1
    assert not dead.exists()
    assert scene.storage.sweep(stray_age_s=0) == 0
    for path in (mine, foreign, namesake):
        os.utime(path, (0, time.time() - 2 * 86400))
    assert scene.storage.sweep(stray_age_s=0) == 3
