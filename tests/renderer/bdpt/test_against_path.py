"""Means equal to those of Mitsuba's `path` in every block, on scenes that break bidirectional path tracers."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.hard_scenes import HARD_SCENES

SIZE, SEEDS, REFERENCE_SEEDS = 16, range(8), range(1000, 1008)
PATH = {"type": "path", "max_depth": 6}
REFERENCE_SPP = {"glass_caustic": 4096}  # path finds the caustic by chance alone


@pytest.mark.parametrize("name", sorted(HARD_SCENES))
def test_means_equal_those_of_path(name: str, renders: Any, assert_equal_means: Any) -> None:
    scene = mi.load_dict(HARD_SCENES[name](SIZE), optimize=False)
    reference = renders(scene, PATH, REFERENCE_SPP.get(name, 512), REFERENCE_SEEDS)
    integrator = {"type": "bdpt", "max_depth": 6, "connections": 1, "light_ratio": 1.0}
    assert_equal_means(renders(scene, integrator, 128, SEEDS), reference)


@pytest.mark.parametrize("name", ["cove", "many_lights"])
@pytest.mark.parametrize(("connections", "light_ratio"), [(0, 0.0), (0, 0.3), (0, 2.0), (3, 0.5)])
def test_means_are_equal_for_all_parameters(
    name: str, connections: int, light_ratio: float, renders: Any, assert_equal_means: Any
) -> None:
    scene = mi.load_dict(HARD_SCENES[name](SIZE), optimize=False)
    reference = renders(scene, PATH, 512, REFERENCE_SEEDS)
    integrator = {"type": "bdpt", "max_depth": 6, "connections": connections, "light_ratio": light_ratio}
    assert_equal_means(renders(scene, integrator, 256, SEEDS), reference)


@pytest.mark.parametrize("rr_depth", [1, 1000])
@pytest.mark.parametrize("max_depth", [1, 2, 3, -1])
def test_depth_and_roulette_mean_what_they_mean_for_path(
    max_depth: int, rr_depth: int, renders: Any, assert_equal_means: Any
) -> None:
    if (max_depth, rr_depth) == (-1, 1000):
        rr_depth = 50  # in a room that loses light at its open side, unbounded paths end by themselves, but late
    scene = mi.load_dict(HARD_SCENES["twosided"](8), optimize=False)
    common = {"max_depth": max_depth, "rr_depth": rr_depth}
    reference = renders(scene, {"type": "path", **common}, 512, REFERENCE_SEEDS)
    assert_equal_means(renders(scene, {"type": "bdpt", **common}, 256, SEEDS), reference)


def with_sensor(**changes: Any) -> Any:
    scene = HARD_SCENES["twosided"](SIZE)
    film = {**scene["sensor"]["film"], **changes.pop("film", {})}
    scene["sensor"] = {**scene["sensor"], **changes, "film": film}
    return scene


@pytest.mark.parametrize(
    "sensor",
    [
        {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 3.0},
        {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0, "near_clip": 2.9, "far_clip": 3.6},
        {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1},
        {"film": {"crop_offset_x": 5, "crop_offset_y": 2, "crop_width": 8, "crop_height": 12}},
        {"near_clip": 3.0},
    ],
    ids=["thin lens", "clipped thin lens", "principal point", "crop", "near plane"],
)
def test_sensors_are_sampled_as_they_are_by_path(sensor: dict[str, Any], renders: Any, assert_equal_means: Any) -> None:
    scene = mi.load_dict(with_sensor(**dict(sensor)), optimize=False)
    reference = renders(scene, PATH, 512, REFERENCE_SEEDS)
    assert_equal_means(renders(scene, {"type": "bdpt", "max_depth": 6}, 128, SEEDS), reference)


def test_a_scaled_scene_gives_the_same_image(renders: Any, assert_equal_means: Any) -> None:
    def scaled(factor: float) -> Any:
        scene = HARD_SCENES["cove"](SIZE)
        for entry in scene.values():
            if isinstance(entry, dict) and "to_world" in entry:
                entry["to_world"] = mi.ScalarTransform4f().scale(factor) @ entry["to_world"]
                if entry["type"] == "perspective":
                    origin = entry["to_world"] @ mi.ScalarPoint3f(0)
                    entry["to_world"] = mi.ScalarTransform4f().look_at(
                        origin=origin, target=[0, 0, factor], up=[0, 0, 1]
                    )
                    entry["near_clip"] = 1e-2 * factor
        return mi.load_dict(scene, optimize=False)

    integrator = {"type": "bdpt", "max_depth": 5}
    small = renders(scaled(1e-2), integrator, 256, SEEDS)
    large = renders(scaled(1e2), integrator, 256, REFERENCE_SEEDS)
    assert_equal_means(small, large)


def test_an_image_is_linear_in_radiance(renders: Any) -> None:
    scene = mi.load_dict(HARD_SCENES["cove"](SIZE), optimize=False)
    parameters = mi.traverse(scene)
    before = renders(scene, {"type": "bdpt", "max_depth": 5}, 4, range(1))
    parameters["light.emitter.radiance.value"] = parameters["light.emitter.radiance.value"] * 8
    parameters.update()
    np.testing.assert_allclose(renders(scene, {"type": "bdpt", "max_depth": 5}, 4, range(1)), before * 8, rtol=1e-4)
