"""Means for all parameters; each hard scene against its truth is in tests/stability."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import pytest

from tests.stability.scenes.hard_scenes import HARD_SCENES

SIZE, SEEDS, REFERENCE_SEEDS = 16, range(8), range(1000, 1008)
PATH = {"type": "path", "max_depth": 6}


@pytest.fixture(scope="module")
def references() -> dict[str, Any]:
    """Images by `path`, by the scene's name: they are compared with those of all parameters."""
    return {}


@pytest.mark.parametrize("name", ["cove", pytest.param("many_lights", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("connections", "light_ratio"), [(0, 0.3), (3, 0.5)])
def test_means_are_equal_for_all_parameters(
    name: str, connections: int, light_ratio: float, renders: Any, references: dict[str, Any], assert_equal_means: Any
) -> None:
    scene = mi.load_dict(HARD_SCENES[name](SIZE), optimize=False)
    if name not in references:
        references[name] = renders(scene, PATH, 512, REFERENCE_SEEDS)
    integrator = {"type": "bdpt", "max_depth": 6, "connections": connections, "light_ratio": light_ratio}
    assert_equal_means(renders(scene, integrator, 256, SEEDS), references[name])


@pytest.mark.parametrize("name", ["cornell", "rotated_envmap"])
def test_several_samples_of_the_lights_leave_the_mean(name: str, renders: Any, assert_equal_means: Any) -> None:
    """Direct light on rough and on smooth surfaces, from lights that paths also hit by themselves."""
    scene = mi.load_dict(HARD_SCENES[name](SIZE), optimize=False)
    images = renders(scene, {"type": "bdpt", "max_depth": 3, "light_samples": 3}, 256, SEEDS)
    assert_equal_means(images, renders(scene, {"type": "path", "max_depth": 3}, 512, REFERENCE_SEEDS))
