"""Light paths that start by a guide: its densities, its images and what it learns."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.guiding import grid, learning
from photonfarm.renderer.bdpt.guiding.learning import DEFAULT_SHARE, PathGuide, estimate_gains
from photonfarm.renderer.bdpt.guiding.starts import Layout, StartGuide
from photonfarm.renderer.bdpt.lights.emission import Lights, read_lights, sample_emission
from tests.stability.scenes import hard_scenes
from tests.stability.weights.weight_check import ball_light, bulb_room, random_usefulness

BDPT = {"type": "bdpt", "max_depth": 5}


def loaded(build: Any, size: int = 16) -> Any:
    return mi.load_dict(build(size), optimize=False)


def at_random(layout: Layout) -> StartGuide:
    return StartGuide.of(layout, 10 ** np.random.default_rng(0).uniform(-1, 1, layout.cells))


def started(lights: Lights, paths: int) -> Any:
    path = dr.arange(mi.UInt32, paths)
    sequence = randomness.stream(randomness.image_keys([1]), randomness.LIGHT) + dr.zeros(mi.UInt32, paths)
    return sample_emission(lights, randomness.sampler(sequence, path), path, dr.opaque(mi.UInt32, paths))


# ------------------------------------------------ Densities ------------------------------------------------


@pytest.mark.parametrize(
    "build", [hard_scenes.many_lights, hard_scenes.rotated_envmap, bulb_room, ball_light], ids=lambda b: b.__name__
)
def test_the_density_of_a_start_is_found_again_from_its_ray(build: Any) -> None:
    scene = loaded(build)
    plain = read_lights(scene)
    lights = plain.guide_with(at_random(Layout.of(plain.count)), scene)
    start = started(lights, 1 << 14)
    ds = mi.DirectionSample3f(start.sample)
    ds.d = -start.ray.d
    found = lights.gain(start.emitter, ds, start.sample.n, start.ray(0.3), start.valid)
    drawn = start.factor / lights.emission_factor(start.emitter)
    valid = np.array(start.valid)
    off = np.abs(np.array(found / drawn) - 1)[valid]
    assert valid.mean() > 0.2
    # Rounding takes a few rays over the edge of their cell
    assert np.mean(off > 1e-3) < 2e-3, f"{np.mean(off > 1e-3):.2g} of {valid.sum()} starts have another density"


@pytest.mark.parametrize("layout", [Layout(9, 8, 2), Layout(9, 4, 1), Layout(9, 1, 1)], ids=str)
def test_starts_fall_into_cells_as_the_guide_says(layout: Layout) -> None:
    scene = loaded(hard_scenes.many_lights)
    plain = read_lights(scene)
    layout = Layout(plain.count, layout.directions, layout.positions)
    lights, paths = plain.guide_with(at_random(layout), scene), 1 << 16
    count = np.bincount(np.array(started(lights, paths).cell), minlength=layout.cells)
    assert lights.guided is not None
    probability = np.diff(np.array(lights.guided.cdf), prepend=0) / np.array(lights.guided.cdf)[-1]
    # One stratified number draws the cell, so a count is off by less than 2, and the rounding of the sums
    assert np.abs(count - paths * probability).max() < 2.1


@pytest.mark.parametrize("towards", [(1, 2, 3), grid._AXIS, (0, 0, 1)], ids=str)
def test_a_light_in_any_direction_has_a_frame(towards: tuple[float, float, float]) -> None:
    """The frame once had no directions for (1, 2, 3), so that all light paths of such a sun were lost."""
    description = hard_scenes.cove(16) | {"sun": {"type": "directional", "direction": [-x for x in towards]}}
    del description["light"]
    scene = mi.load_dict(description, optimize=False)
    plain = read_lights(scene)
    lights = plain.guide_with(at_random(Layout.of(plain.count)), scene)
    start = started(lights, 1024)
    assert np.array(start.valid).all()
    frame = grid.frame_about(dr.normalize(mi.Vector3f(*towards)))
    lengths = [float(np.linalg.norm(np.array(v))) for v in (frame.s, frame.t)]
    np.testing.assert_allclose(lengths, 1, rtol=1e-4)
    assert np.isfinite(np.array(start.ray.o)).all()


# ------------------------------------------------ Images ------------------------------------------------


@pytest.mark.parametrize(("connections", "light_ratio"), [(1, 1.0), (0, 4.0)])
@pytest.mark.parametrize("build", [hard_scenes.many_lights, bulb_room], ids=lambda b: b.__name__)
def test_any_guide_leaves_the_mean(
    build: Any, connections: int, light_ratio: float, renders: Any, assert_equal_means: Any
) -> None:
    scene, spp, seeds = loaded(build), 64, range(12)
    counts = {"connections": connections, "light_ratio": light_ratio}
    plugin = mi.load_dict({**BDPT, **counts, "guided_light": True})
    guide = PathGuide(at_random(Layout.of(len(scene.emitters()))), random_usefulness(seed=2))
    images = [np.array(plugin.render(scene, seed=seed, spp=spp, guide=guide))[..., :3] for seed in seeds]
    assert_equal_means(np.stack(images), renders(scene, {**BDPT, **counts}, spp, range(100, 112)))


def test_guided_light_paths_halve_the_error_of_a_caustic(renders: Any) -> None:
    scene = loaded(hard_scenes.floor_caustic, 32)
    settings = {**BDPT, "connections": 0, "light_ratio": 4.0, "record": True}
    plain, guided = (renders(scene, {**settings, "guided_light": guided}, 32, range(6)) for guided in (False, True))
    assert guided.var(axis=0).mean() < 0.5 * plain.var(axis=0).mean()


def test_equal_seeds_give_equal_images_and_guides() -> None:
    scene, sensor = (found := loaded(hard_scenes.cornell)), found.sensors()[0]
    plugins = [mi.load_dict({**BDPT, "guided_light": True, "record": record}) for record in (False, True, True)]
    images = [np.array(plugin.render(scene, sensor, seed=7, spp=4)) for plugin in plugins]
    np.testing.assert_array_equal(images[1], images[2])
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)
    guides = [plugins[1].learn_guide(scene, sensor, seed) for seed in (7, 7, 8)]
    for a, b, other in ([guide.starts.gain for guide in guides], [guide.usefulness_table for guide in guides]):
        np.testing.assert_array_equal(np.array(a), np.array(b))
        assert not np.array_equal(np.array(a), np.array(other))


def test_a_guide_of_other_lights_is_refused() -> None:
    scene = loaded(hard_scenes.cornell)
    guide = PathGuide(StartGuide.neutral(Layout.of(3)), None)
    with pytest.raises(ValueError, match="learned with 3 lights, the scene has 1"):
        mi.load_dict({**BDPT, "guided_light": True}).render(scene, spp=1, guide=guide)


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_a_guide_that_would_lose_light_is_refused(wrong: float) -> None:
    layout = Layout(1, 2, 1)
    with pytest.raises(ValueError, match="light would be lost"):
        StartGuide.of(layout, np.array([1, 1, wrong, 1]))


# ------------------------------------------------ Learning ------------------------------------------------


def test_gains_follow_the_root_of_what_cells_add() -> None:
    layout = Layout(1, 2, 1)
    starts = np.full(4, 1e6)
    found = estimate_gains(layout, starts * [1, 4, 9, 0], 0.0, starts, 2 * starts, np.ones(1))
    assert found.mean() == pytest.approx(1)
    np.testing.assert_allclose(found, (1 - DEFAULT_SHARE) * np.array([1, 2, 3, 0]) / 1.5 + DEFAULT_SHARE, atol=0.01)


def test_light_paths_start_as_without_a_guide_where_connections_make_the_error() -> None:
    layout = Layout(1, 2, 1)
    starts = np.full(4, 1e6)
    splats, edges = starts * [1, 4, 9, 0], starts * [1, 4, 2, 8]
    found = estimate_gains(layout, splats, 1e4 * splats.sum(), starts, edges, np.ones(1))
    np.testing.assert_allclose(found, 1, atol=1e-3)


@pytest.mark.parametrize(("lights", "cells"), [(1, 1 << 14), (9, 9 << 10), (100, 100 << 6), (1 << 15, 1 << 15)])
def test_more_lights_have_fewer_cells_each(lights: int, cells: int) -> None:
    assert Layout.of(lights).cells == cells


def test_the_paths_that_teach_are_a_small_share_of_an_image() -> None:
    for eye_paths, light_ratio, connections in ((1 << 17, 1.0, 0), (1 << 20, 16.0, 1), (1 << 18, 0.125, 4)):
        effort = learning.Effort.for_image(eye_paths, light_ratio, connections)
        assert effort.eye_paths + effort.light_paths < 0.1 * eye_paths * (1 + light_ratio)
