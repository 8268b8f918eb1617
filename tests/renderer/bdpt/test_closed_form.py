"""Scenes whose image is known in closed form; the answer and its derivation stand above each test."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

COMBINATIONS = [(0, 0.0), (0, 1.0), (1, 1.0), (2, 0.4)]
SEEDS = range(8)


def camera(origin: list[float], target: list[float], fov: float, size: int = 12) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0.1, 1, 0.2]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
    }


def bdpt(connections: int, light_ratio: float, max_depth: int = -1) -> dict[str, Any]:
    return {"type": "bdpt", "connections": connections, "light_ratio": light_ratio, "max_depth": max_depth}


def grey(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def closed_sphere(*, radiance: float | None) -> dict[str, Any]:
    sphere: dict[str, Any] = {"type": "sphere", "flip_normals": True, "bsdf": grey(0.5)}
    if radiance is not None:
        sphere["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "scene", "sensor": camera([0.3, 0.2, 0.1], [1, 0, 0], 60), "sphere": sphere}


# Closed sphere, Le = ½, ρ = ½: L = Le·(1 + ρ + ρ² + …) = Le·(1 − ρᵏ)/(1 − ρ) = 1 − ½ᵏ with paths of k edges, 1
# unbounded.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
@pytest.mark.parametrize(("depth", "answer"), [(1, 0.5), (2, 0.75), (3, 0.875), (-1, 1.0)])
def test_shining_sphere_seen_from_inside(
    connections: int, light_ratio: float, depth: int, answer: float, renders: Any, assert_mean_is: Any
) -> None:
    scene = mi.load_dict(closed_sphere(radiance=0.5))
    assert_mean_is(renders(scene, bdpt(connections, light_ratio, depth), 32, SEEDS), answer)


# The same at depth 24: 1 − ½²⁴. A light path that forgets its later vertices loses energy here.
def test_long_paths_keep_their_energy(renders: Any, assert_mean_is: Any) -> None:
    scene = mi.load_dict(closed_sphere(radiance=0.5))
    integrator = {**bdpt(1, 1.0, 24), "rr_depth": 1000}
    assert_mean_is(renders(scene, integrator, 32, SEEDS), 1 - 0.5**24)


# Point light of intensity π in the centre, radius 1: irradiance π, first bounce ρ/π·π = ½, all bounces ½/(1 − ½) = 1.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_point_light_in_a_closed_sphere(
    connections: int, light_ratio: float, renders: Any, assert_mean_is: Any
) -> None:
    scene = closed_sphere(radiance=None)
    scene["light"] = {"type": "point", "intensity": {"type": "rgb", "value": np.pi}}
    assert_mean_is(renders(mi.load_dict(scene), bdpt(connections, light_ratio), 32, SEEDS), 1.0)


# Four such lights of π/4 each, chosen with unequal probabilities: the same image.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS[1:])
def test_unequally_weighted_lights_add_up(
    connections: int, light_ratio: float, renders: Any, assert_mean_is: Any
) -> None:
    scene = closed_sphere(radiance=None)
    for k in range(4):
        intensity = {"type": "rgb", "value": np.pi / 4}
        scene[f"light{k}"] = {"type": "point", "intensity": intensity, "sampling_weight": 1.0 + k}
    assert_mean_is(renders(mi.load_dict(scene), bdpt(connections, light_ratio), 32, SEEDS), 1.0)


# White furnace: everything reflects or transmits all light, the environment is 1 everywhere, so every radiance is 1.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_white_furnace(connections: int, light_ratio: float, renders: Any, assert_mean_is: Any) -> None:
    scene = {
        "type": "scene",
        "sensor": camera([0, 0, 6], [0, 0, 0], 40),
        "diffuse": {"type": "sphere", "center": [-1, 0, 0], "radius": 0.8, "bsdf": grey(1.0)},
        "glass": {"type": "sphere", "center": [0.9, 0, 0], "radius": 0.7, "bsdf": {"type": "dielectric"}},
        "mirror": {
            "type": "sphere",
            "center": [0, 1.5, 0],
            "radius": 0.5,
            "bsdf": {"type": "conductor", "material": "none"},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
    }
    assert_mean_is(renders(mi.load_dict(scene), bdpt(connections, light_ratio), 32, SEEDS), 1.0)


# Nothing but an environment: its radiance.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_empty_scene(connections: int, light_ratio: float, renders: Any, assert_mean_is: Any) -> None:
    scene = {
        "type": "scene",
        "sensor": camera([0, 0, 6], [0, 0, 0], 40),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.37}},
    }
    assert_mean_is(renders(mi.load_dict(scene), bdpt(connections, light_ratio), 4, SEEDS), 0.37)


def over_a_plane(light: dict[str, Any], reflectance: float = 0.5) -> Any:
    """A camera that looks at the origin of the plane z = 0 through a narrow angle."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20), "bsdf": grey(reflectance)}
    return mi.load_dict({"type": "scene", "sensor": camera([3, 0, 4], [0, 0, 0], 0.2), "plane": plane, "light": light})


NARROW = 512  # few light paths reach the narrow view, so these need more samples


# Point light of intensity I at distance d and angle θ: L = ρ/π·I·cosθ/d².
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_point_light_over_a_plane(connections: int, light_ratio: float, renders: Any, assert_mean_is: Any) -> None:
    scene = over_a_plane({"type": "point", "position": [1, 0, 2], "intensity": {"type": "rgb", "value": 8.0}})
    answer = 0.5 / np.pi * 8 * (2 / np.sqrt(5)) / 5
    assert_mean_is(renders(scene, bdpt(connections, light_ratio, 2), NARROW, SEEDS), answer)


# A 5° spot light that shines straight on the point: inside its beam the same formula.
def test_narrow_spot_light_over_a_plane(renders: Any, assert_mean_is: Any) -> None:
    to_world = mi.ScalarTransform4f().look_at(origin=[1, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    intensity = {"type": "rgb", "value": 8.0}
    scene = over_a_plane(
        {"type": "spot", "to_world": to_world, "cutoff_angle": 5, "beam_width": 4, "intensity": intensity}
    )
    assert_mean_is(renders(scene, bdpt(1, 1.0, 2), NARROW, SEEDS), 0.5 / np.pi * 8 * (2 / np.sqrt(5)) / 5)


# Directional light of irradiance E (across its direction) at angle θ: L = ρ/π·E·cosθ.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS[:3])
def test_directional_light_over_a_plane(
    connections: int, light_ratio: float, renders: Any, assert_mean_is: Any
) -> None:
    scene = over_a_plane({"type": "directional", "direction": [1, 0, -2], "irradiance": {"type": "rgb", "value": 3.0}})
    assert_mean_is(renders(scene, bdpt(connections, light_ratio, 2), NARROW, SEEDS), 0.5 / np.pi * 3 * 2 / np.sqrt(5))


# Rectangle of half sizes a, b parallel above the point at height h (four quarters with a corner straight above it):
# F = 4/(2π)·[A/√(1+A²)·atan(B/√(1+A²)) + B/√(1+B²)·atan(A/√(1+B²))], A = a/h, B = b/h, and L = ρ·Le·F.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_parallel_rectangle_light(connections: int, light_ratio: float, renders: Any, assert_mean_is: Any) -> None:
    a, b, h = 0.7, 0.4, 1.5
    facing_down = mi.ScalarTransform4f().translate([0, 0, h]).rotate([1, 0, 0], 180).scale([a, b, 1])
    light = {
        "type": "rectangle",
        "to_world": facing_down,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
    }
    A, B = a / h, b / h  # noqa: N806
    p, q = np.sqrt(1 + A * A), np.sqrt(1 + B * B)
    form_factor = 2 / np.pi * (A / p * np.arctan(B / p) + B / q * np.arctan(A / q))
    images = renders(over_a_plane(light), bdpt(connections, light_ratio, 2), NARROW, SEEDS)
    assert_mean_is(images, 0.5 * 5 * form_factor)


# Sphere light of radius r at distance d, at angle θ, wholly above the horizon: E = πLe(r/d)²cosθ, L = ρ/π·E.
@pytest.mark.parametrize(("connections", "light_ratio"), COMBINATIONS)
def test_sphere_light_over_a_plane(connections: int, light_ratio: float, renders: Any, assert_mean_is: Any) -> None:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}
    light = {"type": "sphere", "center": [-1, 0, 2], "radius": 0.6, "bsdf": grey(0.0), "emitter": emitter}
    images = renders(over_a_plane(light), bdpt(connections, light_ratio, 2), NARROW, SEEDS)
    assert_mean_is(images, 0.5 * 5 * 0.36 / 5 * 2 / np.sqrt(5))
