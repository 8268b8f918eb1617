"""The two ways to give a job its contents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic_scene import small_spec
from store_samples import guides

from bench.harness.contents import EncodedPool, Pool, commit, commit_encoded
from photonfarm.core.records import Photons, ViewBuffers, Visibility
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneStore, Store

SIZE, SLOTS = 8, 8


def pool(scale: float) -> Pool:
    rng = np.random.default_rng(1)

    def random(*shape: int) -> Any:
        return rng.random(shape, np.float32)

    halves = [scale * random(2, SIZE, SIZE, 3) for _ in range(3)]
    buffers = [ViewBuffers(random(SIZE, SIZE), *random(2, SIZE, SIZE, 3)) for _ in range(2)]
    photons = [Photons(*random(4, SLOTS, 3), bounce=np.zeros(SLOTS, np.int8)) for _ in range(2)]
    visibility = [Visibility(random(16) < 0.5, random(SLOTS) < 0.5) for _ in range(2)]
    return Pool(halves, buffers, [guides(small_spec(), row) for row in range(2)], visibility, photons)


def planned(folder: Path, spec: SceneSpec) -> SceneStore:
    store = Store(folder, create=True)
    request = Request(modifications=3, views_per_modification=2, passes=2)
    return store.scene(store.plan(spec, request, shard_rows=4).scene_id)


def files(scene: SceneStore) -> dict[str, bytes]:
    found = (scene.folder / "plans").rglob("c.*")
    return {str(path.relative_to(scene.folder)): path.read_bytes() for path in found}


@pytest.mark.parametrize("scale", [1.0, 1e6])  # within float16 and beyond
def test_rows_encoded_before_become_the_same_files(tmp_path: Path, scale: float) -> None:
    spec = small_spec(film={"width": SIZE, "height": SIZE})
    ways = [(commit, pool(scale)), (commit_encoded, EncodedPool(pool(scale), spec))]
    found = []
    for number, (way, contents) in enumerate(ways):
        scene = planned(tmp_path / str(number), spec)
        for job in scene.missing_jobs():
            way(scene, job, contents)
        assert not scene.missing_jobs()
        found.append(files(scene))
    assert found[0] == found[1]
    assert len(found[0]) > 20
