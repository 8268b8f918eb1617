"""How useful light vertices are for connections: the table, and what images gain from it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.guiding.grid import Grid
from photonfarm.renderer.bdpt.guiding.learning import PathGuide
from photonfarm.renderer.bdpt.guiding.starts import Layout, StartGuide
from photonfarm.renderer.bdpt.guiding.usefulness import CELLS, LEAST, NORMALS, SIDE, cell_of, estimate_usefulness
from tests.stability.scenes import hard_scenes

CONNECTED = {"type": "bdpt", "max_depth": 6, "connections": 4, "light_ratio": 0.125, "guided_light": True}


def loaded(build: Any, size: int = 32) -> Any:
    return mi.load_dict(build(size), optimize=False)


# ------------------------------------------------ The table ------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_each_direction_of_an_axis_has_cells_of_its_own(axis: int, sign: int) -> None:
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.p = mi.Point3f(0.1, 0.2, 0.3)
    normal = [0.3, 0.2, -0.1]
    normal[axis] = sign * 0.9
    si.n = mi.Normal3f(*normal)
    grid = Grid.over(mi.ScalarBoundingBox3f([-1, -1, -1], [1, 1, 1]), SIDE)
    cell = int(cell_of(grid, si)[0])
    assert cell % NORMALS == 2 * axis + (sign < 0)
    x, y, z = cell // NORMALS % SIDE, cell // NORMALS // SIDE % SIDE, cell // NORMALS // SIDE**2
    # 1.0137 of a half of the box, of cells of its 1.0366th part over 16
    assert (x, y, z) == tuple(int((p + 1 + 2 * 0.01373) / (2 * 1.03664 / SIDE)) for p in (0.1, 0.2, 0.3))


def test_usefulness_is_the_root_of_what_connections_add() -> None:
    connections = np.full(CELLS, 1e6)
    value = np.random.default_rng(0).uniform(0.5, 2, CELLS)
    found = estimate_usefulness(connections * value**2, connections)
    np.testing.assert_allclose(found, value / value.mean(), rtol=1e-3)


def test_no_cell_is_less_useful_than_the_least() -> None:
    connections, sums = np.full(CELLS, 1e6), np.zeros(CELLS)
    sums[: CELLS // 2] = 1e6
    found = estimate_usefulness(sums, connections)
    np.testing.assert_allclose(found[: CELLS // 2], 2, rtol=0.05)
    np.testing.assert_array_equal(found[-CELLS // 4 :], LEAST)


@pytest.mark.parametrize("wrong", [np.full(CELLS, np.nan), np.zeros(CELLS), np.ones(2)], ids=["nan", "zero", "short"])
def test_a_table_that_would_lose_light_is_refused(wrong: Any) -> None:
    with pytest.raises(ValueError, match=r"table of usefulness .* above 0"):
        PathGuide.of(StartGuide.neutral(Layout.of(1)), wrong)


# ------------------------------------------------ Images ------------------------------------------------


def test_useful_vertices_lower_the_error_behind_a_door() -> None:
    scene = loaded(hard_scenes.door_gap)
    plugin = mi.load_dict(CONNECTED | {"record": True})
    learned = plugin.learn_guide(scene, scene.sensors()[0], 1)
    assert learned.usefulness_table is not None
    without = PathGuide(learned.starts, None)
    error = []
    for guide in (without, learned):
        images = np.array([np.array(plugin.render(scene, seed=seed, spp=16, guide=guide)) for seed in range(12)])
        brightness = images.mean(axis=(0, 3))
        level = brightness**2 + 0.01 * brightness.mean() ** 2
        error.append((images.mean(axis=3).var(axis=0) / level).mean())
    assert error[1] < 0.9 * error[0]


def test_an_image_hardly_depends_on_the_number_of_threads() -> None:
    scene = loaded(hard_scenes.cornell)
    plugin = mi.load_dict(CONNECTED)
    guide = PathGuide.of(StartGuide.neutral(Layout.of(1)), np.random.default_rng(0).uniform(0.3, 3, CELLS))
    threads, images = dr.thread_count(), []
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            images.append(np.array(plugin.render(scene, seed=3, spp=16, guide=guide)))
    finally:
        dr.set_thread_count(threads)
    # Sums over the samples of a pixel may differ by their order, light paths and their draws may not
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-6)
