"""A store is upgraded while workers die: its samples stay as they are, and each job's guides are committed once."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.worker import backpressure
from photonfarm.renderer.worker.backpressure import TrainerPace
from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.farm.upgrade import upgrade
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import connect, queue_status
from photonfarm.shared.store import SceneReader, SceneStore, Store
from photonfarm.shared.store.format.declarations import GUIDES

JOBS = 6

Snapshot = dict[str, tuple[bytes, int, int]]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory, analytic: ModuleType) -> Path:
    """A store of an older photonfarm: every sample is there, and nobody has asked for guides."""
    store = Store(tmp_path_factory.mktemp("old") / "store", create=True)
    request = Request(modifications=JOBS // 2, views_per_modification=2, passes=2)
    scene = store.scene(store.plan(analytic.small_spec(), request, shard_rows=2).scene_id)
    render_missing(scene, analytic)
    assert not (scene.folder / "guides").exists()
    return Path(store.root)


@pytest.fixture
def old(template: Path, tmp_path: Path) -> SceneStore:
    """A copy of it."""
    shutil.copytree(template, tmp_path / "store")
    return Store(tmp_path / "store").scenes()[0]


def root(scene: SceneStore) -> Path:
    return scene.folder.parent.parent


def renderer_of(scene: SceneStore, analytic: ModuleType, worker: str = "worker") -> ShardRenderer:
    return ShardRenderer(Store(root(scene)), worker=worker, load=analytic.AnalyticScene.load)


def render_missing(scene: SceneStore, analytic: ModuleType, worker: str = "worker") -> None:
    renderer = renderer_of(scene, analytic, worker)
    for job in scene.missing_jobs():
        renderer.render(scene.scene_id, job)


def snapshot(scene: SceneStore) -> Snapshot:
    """Every file of a scene but its guides': its bytes, and which file it is, and since when."""
    files = [path for path in scene.folder.rglob("*") if path.is_file() and scene.folder / "guides" not in path.parents]
    return {str(path): (path.read_bytes(), path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def guides_of(scene: SceneStore) -> dict[str, bytes]:
    """The bytes of the guides' arrays, by name."""
    folder = scene.folder / "guides/plans"
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def clean_guides(template: Path, analytic: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a store holds once it has been upgraded undisturbed."""
    place = tmp_path_factory.mktemp("clean") / "store"
    shutil.copytree(template, place)
    upgrade(place, None)
    scene = Store(place).scenes()[0]
    render_missing(scene, analytic)
    return guides_of(scene)


# --------------------------------------------------------------------------------------------------------------- killed

RENDER = """
import os, sys
sys.path.append(sys.argv[1])
import analytic_scene as analytic
from photonfarm.renderer.worker import backpressure
from photonfarm.renderer.worker.backpressure import TrainerPace
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.shared.store import Store

def die():
    os.kill(os.getpid(), 9)

store, (job, function, count, when) = Store(sys.argv[2]), sys.argv[3:]
renderer = ShardRenderer(store, worker="doomed", load=analytic.AnalyticScene.load)
for before in range(int(job)):
    assert renderer.render(store.scene_ids()[0], before)
owner = os if hasattr(os, function) else analytic.AnalyticScene
plain, left = getattr(owner, function), iter(range(int(count) - 1, -1, -1))

def dying(*args, **kwargs):
    last = next(left, -1) == 0
    if last and when == "before":
        die()
    result = plain(*args, **kwargs)
    if last:
        die()
    return result

setattr(owner, function, dying)
renderer.render(store.scene_ids()[0], int(job))
"""


def crash(scene: SceneStore, analytic: ModuleType, *point: object) -> None:
    """Render the jobs up to one in a process that kills itself there: at a call of a function of `os` or the scene."""
    command = [sys.executable, "-c", RENDER, str(analytic.FOLDER), str(root(scene)), *map(str, point)]
    done = subprocess.run(command, timeout=60, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


# Of the first job that has guides, one folder is renamed: the declarations; of each, the arrays and the marker linked.
POINTS = {
    "after the guides are declared": (0, "rename", 1, "after"),
    "while it renders": (2, "guides", 1, "before"),
    "after some files": (2, "link", 4, "after"),
    "before the marker": (2, "link", len(GUIDES) + 1, "before"),
    "after the marker": (2, "link", len(GUIDES) + 1, "after"),
}


@pytest.mark.parametrize("where", POINTS)
def test_a_worker_killed_anywhere_in_an_upgrade_loses_nothing_and_the_next_one_completes_it(
    old: SceneStore, analytic: ModuleType, clean_guides: dict[str, bytes], where: str
) -> None:
    before, reader = snapshot(old), SceneReader(root(old), old.scene_id, guides=True)
    upgrade(root(old), None)
    point = POINTS[where]
    crash(old, analytic, *point)
    guided = point[0] + (where == "after the marker")
    assert old.guides.committed_jobs() == set(range(guided)), "whole jobs, and no other"
    assert reader.refresh().size == 2 * guided
    assert all(reader.read(row).guides is not None for row in reader.rows.tolist())
    assert snapshot(old) == before
    assert upgrade(root(old), None).scenes[0].jobs_lacking == JOBS - guided
    render_missing(old, analytic)
    assert (old.missing_jobs(), guides_of(old), snapshot(old)) == ([], clean_guides, before)
    assert reader.refresh().size == 2 * (JOBS - guided)
    Store(root(old)).sweep(stray_age_s=0)
    assert list(old.storage.local("tmp").iterdir()) == []


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")
def test_two_workers_complete_an_upgrade_through_the_queue_though_their_children_are_killed(
    old: SceneStore, analytic: ModuleType, clean_guides: dict[str, bytes], redis_server: EmbeddedRedis
) -> None:
    before = snapshot(old)
    assert upgrade(root(old), redis_server.url).queued == JOBS
    with contextlib.ExitStack() as stack:
        workers = []
        for name in ("one", "other"):
            started = analytic.start_worker(
                root(old), redis_server.url, analytic.command(), until_complete=True, name=name
            )
            workers.append(stack.enter_context(started))
            stack.callback(started.kill)
        analytic.wait_for(lambda: old.guides.committed_jobs())
        for worker in workers:
            if (child := analytic.child_of(worker)) is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
        assert [worker.wait(60) for worker in workers] == [0, 0]
    assert (old.missing_jobs(), guides_of(old), snapshot(old)) == ([], clean_guides, before)
    assert old.guides.committed_jobs() == set(range(JOBS))
    assert queue_status(connect(redis_server.url)).failed == {}


# --------------------------------------------------------------------------------------------------------------- racing


def test_two_workers_racing_for_the_same_guides_commit_them_once(
    old: SceneStore, analytic: ModuleType, clean_guides: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have rendered a job before either commits it."""
    upgrade(root(old), None)
    both, plain = threading.Barrier(2), analytic.AnalyticScene.guides

    def together(*given: object) -> object:
        with contextlib.suppress(threading.BrokenBarrierError):
            both.wait(timeout=10)
        return plain(*given)

    monkeypatch.setattr(analytic.AnalyticScene, "guides", together)
    won: dict[str, list[int]] = {"one": [], "other": []}

    def work(name: str) -> None:
        renderer = renderer_of(old, analytic, name)
        won[name] += [job for job in range(JOBS) if renderer.render(old.scene_id, job)]
        both.abort()

    threads = [threading.Thread(target=work, args=(name,)) for name in won]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(won["one"] + won["other"]) == list(range(JOBS))
    for name, jobs in won.items():
        assert {old.guides.marker(job)["figures"]["worker"] for job in jobs} <= {name}
    assert guides_of(old) == clean_guides


def test_an_upgrade_and_new_samples_at_once_give_what_one_after_the_other_does(
    old: SceneStore, analytic: ModuleType, clean_guides: dict[str, bytes]
) -> None:
    """Jobs planned after the wish for guides bring theirs along; a worker that died between both left the guides."""
    upgrade(root(old), None)
    old.plan(Request(modifications=4, views_per_modification=2, passes=2))
    added = [job for job in old.missing_jobs() if not old.is_committed(job)]
    assert added == list(range(JOBS, old.jobs()))
    crash(old, analytic, JOBS, "render_half", 1, "before")
    reader = SceneReader(root(old), old.scene_id, guides=True)
    assert reader.refresh().size == 2 * JOBS
    assert (JOBS in old.guides.committed_jobs(), old.is_committed(JOBS)) == (True, False)
    first = old.guides.marker(JOBS)
    render_missing(old, analytic)
    assert old.guides.marker(JOBS) == first
    assert reader.refresh().size == old.progress().planned_samples - 2 * JOBS
    for row in reader.rows.tolist():
        sample = reader.read(row)
        assert sample.guides is not None
        assert np.isfinite(sample.radiance).all()
    assert clean_guides.items() <= guides_of(old).items()


def test_samples_that_lack_guides_hold_no_worker_back_from_rendering_these(
    old: SceneStore, analytic: ModuleType, redis_server: EmbeddedRedis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trainer that needs guides has used none, and would wait for ever for a worker that waits for it."""
    monkeypatch.setattr(backpressure, "AHEAD_MINIMUM", 2)
    old.plan(Request(modifications=JOBS, views_per_modification=2, passes=2))
    now_s = [0.0]
    pace = TrainerPace(Store(root(old)), connect(redis_server.url), 1.0, clock=lambda: now_s[0])
    assert old.scene_id in pace.ahead()
    upgrade(root(old), None)
    now_s[0] += 100
    assert pace.ahead() == {}
    renderer = renderer_of(old, analytic)
    for job in range(2):
        renderer.render(old.scene_id, job)
    now_s[0] += 100
    assert pace.ahead()[old.scene_id].startswith("4 samples are committed")
