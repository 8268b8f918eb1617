"""Scenes whose images are known in closed form; each one states the derivation."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from tests.stability.scenes.case import ALL, QUICK, HardScene, SceneDict, known, known_on_plane
from tests.stability.scenes.hard_scenes import camera, grey, rectangle, shining

Points = npt.NDArray[np.float64]  # [N, 3]
Values = npt.NDArray[np.float64]  # [N]


# ------------------------------------------------ Closed spheres ------------------------------------------------


def closed_sphere(size: int) -> SceneDict:
    """The inside of a sphere of reflectance ½ without a light."""
    sensor = camera(size, [0.3, 0.2, 0.1], [1, 0, 0], 60, near_clip=1e-3)
    return {"type": "scene", "sensor": sensor, "sphere": {"type": "sphere", "flip_normals": True, "bsdf": grey(0.5)}}


def shining_sphere(size: int) -> SceneDict:
    """The closed sphere, shining with radiance ½."""
    scene = closed_sphere(size)
    scene["sphere"]["emitter"] = shining(0.5)
    return scene


def point_in_sphere(size: int) -> SceneDict:
    """The closed sphere with a point light of intensity π in its centre, which no ray can hit."""
    return {**closed_sphere(size), "light": {"type": "point", "intensity": {"type": "rgb", "value": np.pi}}}


def four_points_in_sphere(size: int) -> SceneDict:
    """The closed sphere with four lights of intensity π/4 in its centre: the unequal choice of one must cancel."""
    scene = closed_sphere(size)
    for k in range(4):
        intensity = {"type": "rgb", "value": np.pi / 4}
        scene[f"light{k}"] = {"type": "point", "intensity": intensity, "sampling_weight": 1.0 + k}
    return scene


# ------------------------------------------------ Furnaces ------------------------------------------------


def furnace(size: int) -> SceneDict:
    """Bodies that reflect or transmit all light, under a sky of radiance 1: each lost or doubled path shows."""
    mirror = {"type": "conductor", "material": "none"}
    rough = {"type": "roughdielectric", "alpha": 0.002, "distribution": "ggx"}
    return {
        "type": "scene",
        "sensor": camera(size, [0, -6, 0], [0, 0, 0], 40),
        "diffuse": {"type": "sphere", "center": [-1, 0, 0], "radius": 0.8, "bsdf": grey(1.0)},
        "glass": {"type": "sphere", "center": [0.9, 0, 0], "radius": 0.7, "bsdf": {"type": "dielectric"}},
        "rough": {"type": "sphere", "center": [0, 0.3, -1.5], "radius": 0.5, "bsdf": rough},
        "mirror": {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.5, "bsdf": mirror},
        "pane": rectangle([0.6, 0.6], [-1.2, -1.5, 1.2], [0.3, -1, 0], bsdf={"type": "thindielectric"}),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}},
    }


def glass_in_sphere(size: int) -> SceneDict:
    """The shining sphere around a glass ball, a mirror and a pane, which lose no light: radiance is 1 everywhere."""
    mirror = {"type": "conductor", "material": "none"}
    return {
        **shining_sphere(size),
        "glass": {"type": "sphere", "center": [0.6, 0.1, -0.15], "radius": 0.25, "bsdf": {"type": "dielectric"}},
        "mirror": {"type": "sphere", "center": [-0.4, 0.1, 0.1], "radius": 0.35, "bsdf": mirror},
        "pane": rectangle([0.2, 0.2], [0.5, -0.2, 0.3], [1, 0.3, 0.2], bsdf={"type": "thindielectric"}),
    }


def rough_furnace(size: int) -> SceneDict:
    """The furnace with rough glass and rough metal, whose microfacets lose the light that they would scatter twice."""
    rough = {"type": "roughdielectric", "alpha": 0.3, "distribution": "ggx"}
    scene = furnace(size)
    scene["rough"]["bsdf"] = rough
    scene["mirror"]["bsdf"] = {"type": "roughconductor", "material": "none", "alpha": 0.2}
    return scene


def empty(size: int) -> SceneDict:
    """Nothing but a constant sky: light paths hit nothing, the scene has no size."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.37}}
    return {"type": "scene", "sensor": camera(size, [0, 0, 6], [0, 0, 0], 40), "sky": sky}


# ------------------------------------------------ Lights over a plane ------------------------------------------------


def over_a_plane(size: int, light: SceneDict) -> SceneDict:
    """A plane of reflectance ½ at z = 0 below one light."""
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20), "bsdf": grey(0.5)}
    return {"type": "scene", "sensor": camera(size, [3, 0, 4], [0, 0, 0], 30), "plane": plane, "light": light}


def point_over_plane(size: int) -> SceneDict:
    """A plane below a point light of intensity 8 at (1, 0, 2): light tracing against next event estimation."""
    return over_a_plane(size, {"type": "point", "position": [1, 0, 2], "intensity": {"type": "rgb", "value": 8.0}})


def point_radiance(p: Points) -> Values:
    """The radiance L = ρ/π·I·cosθ/d² of the plane under the point light."""
    r2 = np.square(p - [1, 0, 2]).sum(axis=1)
    return 0.5 / np.pi * 8 * 2 / r2**1.5


def sun_over_plane(size: int) -> SceneDict:
    """A plane below a directional light of irradiance 3, which has no solid angle."""
    irradiance = {"type": "rgb", "value": 3.0}
    return over_a_plane(size, {"type": "directional", "direction": [1, 0, -2], "irradiance": irradiance})


def rectangle_over_plane(size: int) -> SceneDict:
    """A plane below a parallel rectangle light of half sizes 0.7 and 0.4 at height 1.5, above the camera."""
    light = rectangle([0.7, 0.4], [0, 0, 1.5], [0, 0, -1], bsdf=grey(0.0), emitter=shining(5.0))
    return {**over_a_plane(size, light), "sensor": camera(size, [2.5, 0, 1.4], [0, 0, 0], 30)}


def rectangle_radiance(p: Points) -> Values:
    """The radiance L = ρ·Le·F of the plane under the rectangle light.

    F is the signed sum, over the four corners, of the form factor of a rectangle with one corner above p,
    F₁ = 1/(2π)·[A/√(1+A²)·atan(B/√(1+A²)) + B/√(1+B²)·atan(A/√(1+B²))], A = a/h, B = b/h (Howell, C-11).
    """

    def corner(a: Values, b: Values) -> Values:
        u, v = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
        return (a / u * np.arctan(b / u) + b / v * np.arctan(a / v)) / (2 * np.pi)

    left, right = (-0.7 - p[:, 0]) / 1.5, (0.7 - p[:, 0]) / 1.5
    low, high = (-0.4 - p[:, 1]) / 1.5, (0.4 - p[:, 1]) / 1.5
    return 0.5 * 5 * (corner(right, high) - corner(left, high) - corner(right, low) + corner(left, low))


def ball_over_plane(size: int) -> SceneDict:
    """A plane wholly below a sphere light of radius 0.6 around (−1, 0, 2): solid angles against areas."""
    light = {"type": "sphere", "center": [-1, 0, 2], "radius": 0.6, "bsdf": grey(0.0), "emitter": shining(5.0)}
    return over_a_plane(size, light)


def ball_radiance(p: Points) -> Values:
    """The radiance L = ρ/π·E of the plane under the sphere light, with E = π·Le·(r/d)²·cosθ."""
    d2 = np.square(p - [-1, 0, 2]).sum(axis=1)
    return 0.5 * 5 * 0.36 / d2 * 2 / np.sqrt(d2)


SPOT = np.array([1.0, 0.0, 2.0])


def spot_over_plane(size: int) -> SceneDict:
    """A 5° spot light of intensity 8, which is full up to 4°; the camera is near, so that the rim is in the image."""
    to_world = mi.ScalarTransform4f().look_at(origin=list(SPOT), target=[0, 0, 0], up=[0, 1, 0])
    intensity = {"type": "rgb", "value": 8.0}
    light = {"type": "spot", "to_world": to_world, "cutoff_angle": 5, "beam_width": 4, "intensity": intensity}
    return {**over_a_plane(size, light), "sensor": camera(size, [0.3, 0, 2], [0, 0, 0], 18)}


def spot_radiance(p: Points) -> Values:
    """The radiance L = ρ/π·I·f(θ)·cosθ/d² of the plane, with f falling linearly from 1 at 4° to 0 at 5°."""
    offset = p - SPOT
    distance = np.linalg.norm(offset, axis=1)
    angle = np.degrees(np.arccos(np.clip(offset @ (-SPOT / np.linalg.norm(SPOT)) / distance, -1, 1)))
    return 0.5 / np.pi * 8 * np.clip(5 - angle, 0, 1) * 2 / distance**3


# ------------------------------------------------ Rows ------------------------------------------------


def _depth(k: int) -> HardScene:
    # Le = ½, ρ = ½: L = Le·(1 + ρ + ρ² + …) = 1 − ½ᵏ with paths of k edges, 1 unbounded
    answer, truth = (1.0, "1") if k < 0 else (1 - 0.5**k, f"1 − ½^{k}")
    name = f"shining-sphere-depth-{k}" if k > 0 else "shining-sphere"
    hard = "every path ends on the light it came from, by every technique at once"
    return HardScene(
        1, name, shining_sphere, known(answer, truth), hard=hard, max_depth=k, quick=QUICK if k in (3, -1) else None
    )


ONE = known(1.0, "1")

SCENES = (
    *(_depth(k) for k in (1, 2, 3, -1)),
    # Irradiance π at radius 1: first bounce ρ/π·π = ½, all bounces ½/(1 − ½) = 1
    HardScene(2, "point-light-in-sphere", point_in_sphere, ONE, max_depth=-1, quick_settings=ALL),
    HardScene(3, "four-lights-in-sphere", four_points_in_sphere, ONE, max_depth=-1, quick_settings=ALL),
    # Everything reflects or transmits all light, and the sky is 1 everywhere, so every radiance is 1
    HardScene(4, "furnace", furnace, ONE, max_depth=-1, quick_settings=ALL),
    HardScene(4, "glass-in-sphere", glass_in_sphere, ONE, max_depth=-1, quick_settings=ALL),
    HardScene(4, "rough-furnace", rough_furnace, max_depth=12, quick=None),
    HardScene(5, "empty", empty, known(0.37, "its radiance 0.37"), quick=replace(QUICK, spp=16), quick_settings=ALL),
    HardScene(
        8,
        "point-over-plane",
        point_over_plane,
        known_on_plane(point_radiance, "I·ρ·cosθ/(π·d²)"),
        max_depth=4,
        quick_settings=ALL,
    ),
    HardScene(
        8,
        "sun-over-plane",
        sun_over_plane,
        known_on_plane(lambda p: np.full(len(p), 0.5 / np.pi * 3 * 2 / np.sqrt(5)), "E·ρ·cosθ/π"),
        max_depth=4,
        quick_settings=ALL,
    ),
    HardScene(
        9,
        "rectangle-over-plane",
        rectangle_over_plane,
        known_on_plane(rectangle_radiance, "form factor"),
        max_depth=4,
        quick_settings=ALL,
    ),
    HardScene(
        10,
        "ball-over-plane",
        ball_over_plane,
        known_on_plane(ball_radiance, "π·L·(r/d)²·cosθ·ρ/π"),
        max_depth=4,
        quick_settings=ALL,
    ),
    HardScene(
        26,
        "narrow-spot",
        spot_over_plane,
        known_on_plane(spot_radiance, "I(θ)·ρ·cosθ/(π·d²)"),
        max_depth=4,
        quick_settings=ALL,
    ),
    # A light path that forgets its later vertices loses energy here
    HardScene(
        36,
        "long-paths",
        shining_sphere,
        known(1 - 0.5**24, "1 − ½^24"),
        hard="24 edges, no roulette: every vertex must be kept",
        max_depth=24,
        rr_depth=1000,
        quick=replace(QUICK, spp=32),
    ),
)
"""The scenes of rows 1–5, 8–10, 26 and 36."""
