"""Which light is chosen: probabilities, frequencies, and what they follow and do not follow."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from photonfarm.renderer.bdpt.guiding import grid
from photonfarm.renderer.bdpt.lights import selection
from photonfarm.renderer.bdpt.lights.emission import read_lights
from tests.stability.scenes.case import load
from tests.stability.scenes.hard_scenes import HARD_SCENES, camera, grey, lit_room, rectangle, shining

SIGNIFICANCE = 1e-5  # of each test over all its comparisons; the seeds are fixed
CELLS = selection.CELLS**3


def table(scene: Any) -> Any:
    """[cells, lights]: probabilities."""
    lights = read_lights(scene)
    assert lights.selection is not None
    return np.array(lights.selection.pmf, np.float64).reshape(CELLS, lights.count)


def two_lights(first: float, second: float) -> Any:
    """A room with two rectangles under its ceiling, on the left and on the right, of these radiances."""
    scene = {name: entry for name, entry in lit_room(8).items() if name != "light"}
    scene["first"] = rectangle([0.1, 0.1], [-0.8, 0, 1.95], [0, 0, -1], emitter=shining(first))
    scene["second"] = rectangle([0.1, 0.1], [0.8, 0, 1.95], [0, 0, -1], emitter=shining(second))
    return load(scene)


def number_of(scene: Any, shape: str) -> int:
    """Number of a shape's light among the scene's."""
    ids = [emitter.get_shape().id() if emitter.get_shape() else emitter.id() for emitter in scene.emitters()]
    return ids.index(shape)


# ------------------------------------------------ Probabilities ------------------------------------------------


@pytest.mark.parametrize("name", ["many_lights", "hundred_lights"])
def test_probabilities_sum_to_one_in_every_cell_and_are_positive_for_what_shines(name: str) -> None:
    scene = load(HARD_SCENES[name](8))
    probabilities = table(scene)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    dark = np.array([_is_dark(emitter) for emitter in scene.emitters()])
    assert (dark.sum() > 0) == (name == "hundred_lights")
    assert (probabilities[:, ~dark] > 0).all()
    assert (probabilities[:, dark] == 0).all()


def test_points_that_are_not_finite_are_in_some_cell() -> None:
    lights = read_lights(two_lights(1.0, 2.0))
    points = mi.Point3f([np.nan, np.inf, 0.5, -np.inf], [0.5, np.nan, np.nan, np.nan], [np.nan, 0.5, np.inf, np.nan])
    number, probability = lights.selection.choose(points, dr.opaque(mi.Float, 0.5, 4))
    assert (np.array(number) < 2).all()
    assert np.isin(np.array(probability), np.array(lights.selection.pmf)).all()
    assert (np.array(lights.selection.grid.cell(points)) < CELLS).all()


def _is_dark(emitter: Any) -> bool:
    parameters = mi.traverse(emitter)
    keys = [key for key in parameters.keys() if key.endswith(".value")]  # noqa: SIM118 - no mapping
    return not max(np.max(np.array(parameters[key])) for key in keys) > 0


def test_a_light_that_goes_out_has_probability_zero_everywhere_and_comes_back() -> None:
    scene = two_lights(1.0, 1.0)
    parameters, before = mi.traverse(scene), table(scene)
    parameters["first.emitter.radiance.value"] = mi.Color3f(0)
    parameters.update()
    out = table(scene)
    first = number_of(scene, "first")
    assert (out[:, first] == 0).all()
    np.testing.assert_allclose(out[:, 1 - first], 1, atol=1e-5)
    parameters["first.emitter.radiance.value"] = mi.Color3f(1)
    parameters.update()
    np.testing.assert_array_equal(table(scene), before)


def test_light_paths_start_with_the_mean_of_the_probabilities() -> None:
    scene = load(HARD_SCENES["many_lights"](8))
    lights = read_lights(scene)
    started = np.diff(np.array(lights.emit_cdf, np.float64), prepend=0)
    np.testing.assert_allclose(started / started.sum(), table(scene).mean(axis=0), rtol=1e-4, atol=1e-6)


# ------------------------------------------------ Frequencies ------------------------------------------------


@pytest.mark.parametrize("name", ["many_lights", "hundred_lights"])
def test_lights_are_chosen_as_often_as_their_probabilities_say(name: str) -> None:
    scene = load(HARD_SCENES[name](8))
    lights = read_lights(scene)
    chooser = lights.selection
    assert chooser is not None
    n, rng = 20000, np.random.default_rng(3)
    for place in rng.uniform([-1, -1, 0], [1, 1, 2], (6, 3)):
        p = mi.Point3f(*(dr.full(mi.Float, float(x), n) for x in place))
        chosen, probability = chooser.choose(p, mi.Float(rng.random(n, np.float32)))
        numbers = np.array(chosen)
        said = np.array(
            [np.array(chooser.probability(p, emitter))[0] for emitter in map(mi.EmitterPtr, scene.emitters())]
        )
        np.testing.assert_allclose(np.array(probability), said[numbers], rtol=1e-6)
        counts = np.bincount(numbers, minlength=lights.count)
        assert not counts[said == 0].any()
        assert stats.chisquare(*_pooled(counts, said * n)).pvalue > SIGNIFICANCE / 6


def _pooled(counts: Any, expected: Any) -> tuple[Any, Any]:
    """(counts, expected counts) with all rare lights in one bin, as chi² needs; scaled to the same sum."""
    rare = expected < 10
    pooled = [np.append(values[~rare], values[rare].sum()).astype(np.float64) for values in (counts, expected)]
    kept = pooled[1] > 0
    return pooled[0][kept], pooled[1][kept] * pooled[0][kept].sum() / pooled[1][kept].sum()


# ------------------------------------------------ What they follow ------------------------------------------------


def test_a_light_of_a_thousand_times_the_power_is_preferred_accordingly() -> None:
    def first_share(radiance: float) -> Any:
        """[cells]: share of the first light in what both cast; all but the defensive share follows it."""
        scene = two_lights(radiance, 1.0)
        own = selection._DEFENSIVE / 2
        return (table(scene)[:, number_of(scene, "first")] - own) / (1 - selection._DEFENSIVE)

    equal, brighter = first_share(1.0), first_share(1000.0)
    mixed = (equal > 1e-3) & (equal < 1 - 1e-3)  # the others see one of them only
    assert mixed.sum() > CELLS / 2
    np.testing.assert_allclose(brighter[mixed], (1000 * equal / (1000 * equal + 1 - equal))[mixed], atol=2e-3)
    assert np.median(brighter) > 0.99


# ------------------------------------------------ Edges of cells ------------------------------------------------


# A wall that lies in the plane between two layers of cells: its points are in one layer, rays that leave it start in
# the other. Behind it a bright light, before it the one that lights it; next event estimation and hits must agree on
# how probable that one is.
@pytest.mark.parametrize("facing", [1, -1])
@pytest.mark.parametrize("counts", [(0, 0.0), (1, 1.0)])
def test_a_wall_between_two_layers_of_cells_is_as_bright_as_it_should_be(
    facing: int, counts: tuple[int, float], renders: Any, assert_equal_means: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grid, "_MARGIN", (0.0, 0.0))  # so that the wall does lie there
    black = grey(0.0)
    scene = load(
        {
            "type": "scene",
            "sensor": camera(8, [0, 0, 0.95 * facing], [0, 0, 0], 60, near_clip=1e-3),
            "low": rectangle([1, 1], [0, 0, -1], [0, 0, 1], bsdf=black),
            "high": rectangle([1, 1], [0, 0, 1], [0, 0, -1], bsdf=black),
            "wall": rectangle([1, 1], [0, 0, 0], [0, 0, facing], bsdf=grey(0.5)),
            "light": rectangle([0.9, 0.9], [0, 0, 0.99 * facing], [0, 0, -facing], emitter=shining(1.0)),
            "other": rectangle([0.9, 0.9], [0, 0, -0.1 * facing], [0, 0, -facing], emitter=shining(100.0)),
        }
    )
    bdpt = {"type": "bdpt", "max_depth": 3, "connections": counts[0], "light_ratio": counts[1]}
    reference = renders(scene, {"type": "path", "max_depth": 3}, 256, range(1000, 1008))
    assert_equal_means(renders(scene, bdpt, 128, range(8)), reference)


# ------------------------------------------------ Kernels ------------------------------------------------
