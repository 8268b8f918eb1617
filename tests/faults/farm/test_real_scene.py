"""The same with Mitsuba: a worker killed in the middle, and the bits of an undisturbed one."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.queue import connect, queue_status
from photonfarm.renderer.worker.worker import CHILD, run_worker
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.store import SceneReader, SceneStore, Store


def room_of_16_pixels(root: Path) -> SceneStore:
    """The built-in box with a movable block: 4 modifications, 3 views, jobs of 3 samples."""
    block = {
        "name": "block",
        "shapes": ["tall-block"],
        "at": [0, 0, 0],
        "box": {"min": [-0.2, 0, -0.2], "max": [0.2, 0, 0.2]},
    }
    described = {
        "name": "box",
        "scene": {"builtin": "cornell"},
        "objects": [block],
        "points": 64,
        "exposure": 3.0,
        "view": {
            "origin": {"min": [-0.5, 0.5, 0.8], "max": [0.5, 1.5, 1.5]},
            "look_at": {"min": [-0.5, 0.5, -0.5], "max": [0.5, 1.0, 0.0]},
        },
        "film": {"width": 16, "height": 16},
        "transport": {"half_spp": 2},
        "photons": {"paths": 32, "depth": 2},
    }
    store = Store(root, create=True)
    request = Request(modifications=4, views_per_modification=3)
    return store.scene(store.plan(parse_spec(described, where="test"), request, shard_rows=3).scene_id)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the worker's child through /proc")
def test_a_worker_killed_in_the_middle_changes_no_bit_of_what_mitsuba_renders(
    analytic: ModuleType, stored_bytes: Callable[[SceneStore], dict[str, bytes]], tmp_path: Path
) -> None:
    clean, shaken = room_of_16_pixels(tmp_path / "clean"), room_of_16_pixels(tmp_path / "shaken")
    with EmbeddedRedis(tmp_path / "redis-clean") as server:
        run_worker(tmp_path / "clean", server.url, until_complete=True, idle_s=1)
    with (
        EmbeddedRedis(tmp_path / "redis-shaken") as server,
        analytic.start_worker(tmp_path / "shaken", server.url, CHILD, until_complete=True) as running,
    ):
        analytic.wait_for(lambda: queue_status(connect(server.url)).running == 1, 60)
        os.kill(analytic.child_of(running), signal.SIGKILL)
        assert running.wait(120) == 0, running.stderr.read().decode()
    assert clean.missing_jobs() == shaken.missing_jobs() == []
    assert stored_bytes(clean) == stored_bytes(shaken)

    reader = SceneReader(tmp_path / "shaken", shaken.scene_id)
    for row in reader.refresh():
        a, b = reader.read(int(row)).radiance
        assert np.isfinite(a).all()
        assert a.mean() > 0
        assert not np.array_equal(a, b)
    assert (reader.read_photons(0).bounce >= 0).any()
    geometry, cloud = reader.base()
    assert len(cloud.position) == 64
    assert len(geometry.faces) == len(geometry.face_shape)
