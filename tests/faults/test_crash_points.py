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

from photonfarm.renderer.jobs import ShardRenderer
from photonfarm.shared.plan import Request
from photonfarm.shared.store import SceneReader, SceneStore, Store

COMMIT = """
import importlib.util, os, sys
from photonfarm.shared.store import Store
from photonfarm.renderer.jobs import ShardRenderer
spec = importlib.util.spec_from_file_location("analytic_scene", sys.argv[1])
analytic = importlib.util.module_from_spec(spec)
spec.loader.exec_module(analytic)

function, count, when = sys.argv[4], int(sys.argv[5]), sys.argv[6]
plain = getattr(os, function)

def dying(*args, **kwargs):
    global count
    count -= 1
    if count == 0 and when == "before":
        os.kill(os.getpid(), 9)
    result = plain(*args, **kwargs)
    if count == 0:
        os.kill(os.getpid(), 9)
    return result

renderer = ShardRenderer(Store(sys.argv[2]), worker="doomed", load=analytic.AnalyticScene.load)
if sys.argv[3] != "base":
    Store(sys.argv[2]).scenes()[0].write_base(*analytic.AnalyticScene(analytic.small_spec()).base())
setattr(os, function, dying)
if sys.argv[3] == "plan":
    from photonfarm.shared.plan import Request
    Store(sys.argv[2]).plan(analytic.small_spec(), Request(modifications=9))
else:
    renderer.render(Store(sys.argv[2]).scene_ids()[0], 0)
"""

# A commit of this job writes 9 arrays and the marker: a link each.
POINTS = {
    "after the first temporary file": ("commit", "fdatasync", 1, "after"),
    "in the middle, before a link": ("commit", "link", 5, "before"),
    "in the middle, after a link": ("commit", "link", 5, "after"),
    "after all files, before the folders are synced": ("commit", "fsync", 1, "before"),
    "before the marker": ("commit", "link", 10, "before"),
    "after the marker": ("commit", "link", 10, "after"),
    "while the base is written": ("base", "fsync", 3, "before"),
    "before the base gets its name": ("base", "rename", 1, "before"),
    "after the base has got its name": ("base", "rename", 1, "after"),
}


def crash(analytic: ModuleType, store: Path, *point: object) -> None:
    command = [sys.executable, "-c", COMMIT, analytic.__spec__.origin, str(store), *map(str, point)]
    assert subprocess.run(command, timeout=60).returncode == -signal.SIGKILL


@pytest.mark.parametrize("point", POINTS.values(), ids=POINTS.keys())
def test_a_writer_killed_at_any_point_leaves_all_or_nothing(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    clean_bytes: Callable[[int], dict[str, bytes]],
    stored_bytes: Callable[[SceneStore], dict[str, bytes]],
    point: tuple[str, str, int, str],
) -> None:
    scene = planned(1)
    root = scene.folder.parent.parent
    crash(analytic, root, *point)

    reader = SceneReader(root, scene.scene_id)
    after_marker = point == POINTS["after the marker"]
    assert reader.refresh().size == (2 if after_marker else 0)
    for row in reader.rows:
        reader.read(int(row))
    renderer = ShardRenderer(Store(root), worker="next", load=analytic.AnalyticScene.load)
    for job in scene.missing_jobs():
        renderer.render(scene.scene_id, job)
    assert stored_bytes(scene) == clean_bytes(1)
    Store(root).sweep(stray_age_s=0)
    assert list(scene.storage.local("tmp").iterdir()) == []


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
