"""Small scenes that are hard for bidirectional path tracers, as dictionaries for ``mi.load_dict``.

Tests and benchmarks use them.

Each function takes the image size in pixels. All have a box filter and an ``hdrfilm``; lengths have no particular unit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from tests.stability.scenes.case import SceneDict


def camera(size: int, origin: list[float], target: list[float], fov: float, **more: Any) -> SceneDict:
    """A perspective camera with an independent sampler and a box filter; ``more`` overrides."""
    up = (
        [0, 0, 1]
        if abs(origin[2] - target[2]) < 0.9 * float(np.linalg.norm(np.subtract(origin, target)))
        else [0, 1, 0]
    )
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
        **more,
    }


def grey(value: float) -> SceneDict:
    """A diffuse material of this reflectance."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def rectangle(half: list[float], at: list[float], facing: list[float], **more: Any) -> SceneDict:
    """A rectangle of half sizes ``half`` around ``at`` whose front looks along ``facing``."""
    up = [0, 1, 0] if abs(facing[1]) < 0.9 else [0, 0, 1]
    frame = mi.ScalarTransform4f().look_at(origin=at, target=list(np.add(at, facing)), up=up)
    return {"type": "rectangle", "to_world": frame @ mi.ScalarTransform4f().scale([half[0], half[1], 1]), **more}


def shining(radiance: float | list[float]) -> SceneDict:
    """An area emitter of this radiance, grey or RGB."""
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def room(reflectance: float = 0.6) -> SceneDict:
    """Inside of the box [−1, 1]²×[0, 2], without its wall at y = −1."""
    return {
        "floor": rectangle([1, 1], [0, 0, 0], [0, 0, 1], bsdf=grey(reflectance)),
        "ceiling": rectangle([1, 1], [0, 0, 2], [0, 0, -1], bsdf=grey(reflectance)),
        "back": rectangle([1, 1], [0, 1, 1], [0, -1, 0], bsdf=grey(reflectance)),
        "left": rectangle([1, 1], [-1, 0, 1], [1, 0, 0], bsdf=grey(reflectance)),
        "right": rectangle([1, 1], [1, 0, 1], [-1, 0, 0], bsdf=grey(reflectance)),
    }


def lit_room(size: int) -> SceneDict:
    """The open room with a rectangle light under its ceiling, just out of the picture (its rim would be noise)."""
    return {
        "type": "scene",
        "sensor": camera(size, [0, -3.2, 0.8], [0, 0, 0.8], 36),
        **room(),
        "light": rectangle([0.3, 0.3], [0, 0, 1.95], [0, 0, -1], emitter=shining([8.0, 7.0, 6.0])),
    }


def bumps(size: int = 16) -> Any:
    """[size, size, 1] random heights in [0, 1)."""
    return np.random.default_rng(1).random((size, size, 1)).astype(np.float32)


def environment(width: int = 32) -> Any:
    """A concentrated environment: a bright spot on a dim gradient."""
    image = np.full((width // 2, width, 3), 0.2, np.float32)
    image[:, :, 2] += np.linspace(0, 0.3, width, dtype=np.float32)
    image[width // 8 : width // 8 + 2, width // 5 : width // 5 + 3] = [40.0, 30.0, 20.0]
    return mi.Bitmap(image)


# ------------------------------------------------ The scenes ------------------------------------------------


def cornell(size: int) -> SceneDict:
    """Mitsuba's Cornell box."""
    scene: SceneDict = mi.cornell_box()
    scene["sensor"]["film"].update(width=size, height=size, rfilter={"type": "box"})
    return scene


def glass_caustic(size: int) -> SceneDict:
    """A glass sphere between a small area light and a floor: the caustic is hardly found from the camera."""
    return {
        "type": "scene",
        "sensor": camera(size, [0, -4, 2.2], [0, 0.2, 0.3], 35),
        "floor": rectangle([2, 2], [0, 0, 0], [0, 0, 1], bsdf=grey(0.6)),
        "ball": {
            "type": "sphere",
            "center": [0, 0, 0.6],
            "radius": 0.5,
            "bsdf": {"type": "dielectric", "int_ior": 1.5},
        },
        "light": rectangle([0.1, 0.1], [0.7, 0, 2.8], [-0.25, 0, -1], emitter=shining(60.0)),
    }


def floor_caustic(size: int) -> SceneDict:
    """The caustic of a glass sphere in the light of a small area light, with the sphere out of the picture.

    So every path to the light that the image needs has one diffuse vertex at which a light path can be joined to the
    lens; in `glass_caustic` some are seen twice through glass, which no joining reaches.
    """
    return {
        **glass_caustic(size),
        "light": rectangle([0.03, 0.03], [0.7, 0, 2.8], [-0.25, 0, -1], emitter=shining(660.0)),
        "sensor": camera(size, [-1.5, -2, 0.9], [-0.4, 0, 0], 18),
        "ball": {
            "type": "sphere",
            "center": [0, 0, 1.0],
            "radius": 0.5,
            "bsdf": {"type": "dielectric", "int_ior": 1.5},
        },
    }


def cove(size: int) -> SceneDict:
    """A room lit by a light that shines at the ceiling from above a shelf: all light in the image is indirect."""
    return {
        "type": "scene",
        "sensor": camera(size, [0, -3.2, 1], [0, 0, 1], 40),
        **room(),
        "shelf": rectangle([0.5, 0.5], [0, 0, 1.5], [0, 0, -1], bsdf={"type": "twosided", "b": grey(0.5)}),
        "light": rectangle([0.15, 0.15], [0, 0, 1.55], [0, 0, 1], emitter=shining([20.0, 18.0, 15.0])),
    }


def rotated_envmap(size: int) -> SceneDict:
    """A concentrated environment map, turned about two axes, over a floor and a ball."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 70) @ mi.ScalarTransform4f().rotate([0, 1, 0], 130)
    return {
        "type": "scene",
        "sensor": camera(size, [0, -4, 2], [0, 0, 0.3], 40),
        "floor": rectangle([1.5, 1.5], [0, 0, 0], [0, 0, 1], bsdf=grey(0.5)),
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5, "bsdf": grey(0.7)},
        "sky": {"type": "envmap", "bitmap": environment(), "to_world": turn},
    }


def constant_environment(size: int) -> SceneDict:
    """A constant environment around a room that is open to the front."""
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": "roughconductor", "alpha": 0.2}}
    return {
        "type": "scene",
        "sensor": camera(size, [0, -3.2, 1], [0, 0, 1], 40),
        **room(),
        "ball": ball,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.7, 1.0]}},
    }


def bump_floor(size: int) -> SceneDict:
    """A strongly bump-mapped rough floor in a room with an area light.

    Shading and geometric normals differ everywhere.
    """
    bumped = {
        "type": "bumpmap",
        "texture": {"type": "bitmap", "raw": True, "data": mi.TensorXf(bumps())},
        "scale": 0.06,
        "bsdf": {"type": "roughplastic", "alpha": 0.2},
    }
    return {**lit_room(size), "floor": rectangle([1, 1], [0, 0, 0], [0, 0, 1], bsdf=bumped)}


def normal_floor(size: int) -> SceneDict:
    """A floor with a strong normal map in a lit room: `ptracer` is off by up to 23 %."""
    slope = (bumps()[..., 0] - 0.5) * 0.9
    normals = np.stack([slope, slope.T, np.sqrt(1 - slope**2 - slope.T**2)], axis=-1) * 0.5 + 0.5
    mapped = {
        "type": "normalmap",
        "normalmap": {"type": "bitmap", "raw": True, "data": mi.TensorXf(normals.astype(np.float32))},
        "bsdf": grey(0.7),
    }
    return {**lit_room(size), "floor": rectangle([1, 1], [0, 0, 0], [0, 0, 1], bsdf=mapped)}


def rough_dielectric(size: int) -> SceneDict:
    """A ball of rough glass in a lit room."""
    glass = {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.5, "distribution": "ggx"}
    return {**lit_room(size), "ball": {"type": "sphere", "center": [0, -0.2, 0.5], "radius": 0.45, "bsdf": glass}}


def mask(size: int) -> SceneDict:
    """A half-transparent screen before the light and another before the camera."""
    veil = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "b": grey(0.5)}}
    return {
        **lit_room(size),
        "light_veil": rectangle([0.5, 0.5], [0, 0, 1.7], [0, 0, -1], bsdf=veil),
        "camera_veil": rectangle([0.6, 0.6], [0, -1.5, 1], [0, -1, 0], bsdf=veil),
    }


def twosided(size: int) -> SceneDict:
    """Thin two-sided sheets with different sides, and a coarse ball with smooth normals."""
    sheet = {"type": "twosided", "front": grey(0.8), "back": {"type": "roughconductor", "alpha": 0.3}}
    return {
        **lit_room(size),
        "sheet": rectangle([0.4, 0.4], [-0.4, 0.2, 0.9], [0.5, -1, 0.4], bsdf=sheet),
        "second": rectangle([0.3, 0.3], [0.5, 0, 0.6], [0.3, 1, 0.2], bsdf=sheet),
    }


def plastics(size: int) -> SceneDict:
    """Layered materials whose lobes are chosen at random, one of them a mirror: plastic, principled, blends."""
    balls = {
        "plastic": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.3, 0.6]}},
        "principled": {"type": "principled", "roughness": 0.3, "metallic": 0.3, "clearcoat": 0.5, "spec_trans": 0.4},
        "blend": {"type": "blendbsdf", "weight": 0.4, "a": grey(0.6), "b": {"type": "conductor"}},
    }
    scene = lit_room(size)
    for k, (name, bsdf) in enumerate(balls.items()):
        scene[name] = {"type": "sphere", "center": [-0.6 + 0.6 * k, 0, 0.3], "radius": 0.27, "bsdf": bsdf}
    return scene


def textured_light(size: int) -> SceneDict:
    """A room lit by a rectangle with a texture of dark and bright texels."""
    pattern = np.zeros((4, 4, 3), np.float32)
    pattern[0, 1], pattern[2, 3], pattern[3, 0] = [40.0, 10.0, 5.0], [5.0, 30.0, 10.0], [5.0, 5.0, 50.0]
    radiance = {"type": "bitmap", "raw": True, "data": mi.TensorXf(pattern), "filter_type": "nearest"}
    scene = lit_room(size)
    scene["light"]["emitter"] = {"type": "area", "radiance": radiance}
    return scene


def many_lights(size: int) -> SceneDict:
    """Lights of every kind at once: area (rectangle, sphere, disk, mesh), point, spot, directional, constant."""
    light_cube = mi.ScalarTransform4f().translate([0.6, 0.4, 1.4]) @ mi.ScalarTransform4f().scale(0.08)
    beam = mi.ScalarTransform4f().look_at(origin=[0, -0.5, 1.8], target=[0.2, 0.5, 0], up=[0, 1, 0])
    disk = mi.ScalarTransform4f().look_at(
        origin=[0, 0.9, 0.8], target=[0, 0, 0.8], up=[0, 0, 1]
    ) @ mi.ScalarTransform4f().scale(0.1)
    return {
        **lit_room(size),
        "ball_light": {
            "type": "sphere",
            "center": [-0.6, 0.3, 0.4],
            "radius": 0.1,
            "emitter": shining([1.0, 4.0, 1.0]),
        },
        "disk_light": {"type": "disk", "to_world": disk, "emitter": shining([6.0, 1.0, 1.0])},
        "mesh_light": {"type": "cube", "to_world": light_cube, "emitter": shining([1.0, 1.0, 5.0])},
        "bulb": {"type": "point", "position": [0.5, -0.6, 0.7], "intensity": {"type": "rgb", "value": 0.3}},
        "beam": {"type": "spot", "to_world": beam, "cutoff_angle": 20, "intensity": {"type": "rgb", "value": 1.0}},
        "sun": {"type": "directional", "direction": [0.3, 1, -0.4], "irradiance": {"type": "rgb", "value": 0.4}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.15, 0.2]}},
    }


def door_gap(size: int) -> SceneDict:
    """A room lit through a narrow gap in its right wall; the light in the hall beyond shines away from the gap."""
    return {
        "type": "scene",
        "sensor": camera(size, [0, -3.2, 1], [0, 0, 1], 40),
        **{name: wall for name, wall in room().items() if name != "right"},
        "right": rectangle([0.75, 1], [1, -0.25, 1], [-1, 0, 0], bsdf=grey(0.6)),
        "door": rectangle([0.2, 1], [1, 0.8, 1], [-1, 0, 0], bsdf=grey(0.6)),  # the gap: 0.5 < y < 0.6
        **_hall(),
        "light": rectangle([0.15, 0.15], [1.7, -0.4, 1.2], [1, -0.3, 0.3], emitter=shining([60.0, 55.0, 45.0])),
    }


def _hall(reflectance: float = 0.7) -> SceneDict:
    """The hall 1 < x < 3 beside the room of `door_gap`, closed but for the gap."""
    return {
        "hall_floor": rectangle([1, 1], [2, 0, 0], [0, 0, 1], bsdf=grey(reflectance)),
        "hall_ceiling": rectangle([1, 1], [2, 0, 2], [0, 0, -1], bsdf=grey(reflectance)),
        "hall_end": rectangle([1, 1], [3, 0, 1], [-1, 0, 0], bsdf=grey(reflectance)),
        "hall_front": rectangle([1, 1], [2, -1, 1], [0, 1, 0], bsdf=grey(reflectance)),
        "hall_back": rectangle([1, 1], [2, 1, 1], [0, -1, 0], bsdf=grey(reflectance)),
    }


def mirror_room(size: int) -> SceneDict:
    """A corridor between two mirrors, with a small light: most light arrives by several mirrorings."""
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": 0.9}}
    scene = lit_room(size)
    scene["left"]["bsdf"] = scene["right"]["bsdf"] = mirror
    scene["back"]["bsdf"] = {"type": "roughconductor", "alpha": 0.15}
    scene["ball"] = {"type": "sphere", "center": [0.3, -0.2, 0.35], "radius": 0.3, "bsdf": grey(0.7)}
    scene["light"] = rectangle([0.1, 0.1], [-0.3, 0.1, 1.6], [0.2, -0.1, 1], emitter=shining([50.0, 45.0, 40.0]))
    return scene


def hundred_lights(size: int) -> SceneDict:
    """A room under a hundred small lights whose radiances span 1:10⁴; every tenth is dead (radiance 0)."""
    scene = lit_room(size)
    del scene["light"]
    radiance = 10 ** np.random.default_rng(7).uniform(-2, 2, 100)
    for k in range(100):
        at = [-0.9 + 0.2 * (k % 10), -0.9 + 0.1 * (k // 10), 1.9]  # out of the picture, as in `lit_room`
        value = 0.0 if k % 10 == 3 else float(radiance[k])
        scene[f"light_{k:02d}"] = rectangle([0.04, 0.04], at, [0, 0, -1], emitter=shining(value))
    return scene


HARD_SCENES: dict[str, Callable[[int], SceneDict]] = {
    scene.__name__: scene
    for scene in (
        cornell,
        glass_caustic,
        floor_caustic,
        cove,
        rotated_envmap,
        constant_environment,
        bump_floor,
        normal_floor,
        rough_dielectric,
        mask,
        twosided,
        plastics,
        textured_light,
        many_lights,
        door_gap,
        mirror_room,
        hundred_lights,
    )
}
"""Every scene above by its name."""
