"""Scenes that are hard because of their lights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.stability.scenes import hard_scenes
from tests.stability.scenes.case import (
    ALL,
    LONG,
    QUICK,
    WITH_LIGHT_PATHS,
    HardScene,
    SceneDict,
    rendered,
)
from tests.stability.scenes.hard_scenes import camera, grey, lit_room, rectangle, shining
from tests.stability.scenes.meshes import grid, octahedron

# ------------------------------------------------ Lights at infinity, and edits ------------------------------------

SHIFT = [4.5, 0.0, 0.0]


def _under_sky_and_sun(size: int, block: Any) -> SceneDict:
    return {
        "type": "scene",
        "sensor": camera(size, [2, -8, 3], [2, 0, 0.4], 42),
        "floor": rectangle([1.5, 1.5], [0, 0, 0], [0, 0, 1], bsdf=grey(0.5)),
        "block": {"type": "cube", "bsdf": grey(0.7), "to_world": block},
        "sun": {"type": "directional", "direction": [0.3, 1, -1], "irradiance": {"type": "rgb", "value": 2.0}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.7, 1.0]}},
    }


def block_at_home(size: int) -> SceneDict:
    """A block on a floor, under a sky and a sun, which must reach it where it is moved to."""
    return _under_sky_and_sun(size, mi.ScalarTransform4f().translate([0, 0, 0.8]).scale(0.8))


def block_far_away(size: int) -> SceneDict:
    """The scene of `block_at_home`, its block outside of the former bounding sphere but still in the picture."""
    return _under_sky_and_sun(size, mi.ScalarTransform4f().translate(SHIFT).translate([0, 0, 0.8]).scale(0.8))


def move_block(scene: Any) -> None:
    """Move the block in the loaded scene to where it is in `block_far_away`."""
    parameters = mi.traverse(scene)
    vertices = dr.unravel(mi.Point3f, parameters["block.vertex_positions"])
    parameters["block.vertex_positions"] = dr.ravel(vertices + mi.Point3f(*SHIFT))
    parameters.update()


# ------------------------------------------------ Light through glass ------------------------------------------------


def point_caustic(size: int) -> SceneDict:
    """The caustic of a point light under a glass ball out of the picture: `path` misses it."""
    glass = {"type": "dielectric", "int_ior": 1.5}
    return {
        "type": "scene",
        "sensor": camera(size, [-0.3, -3, 1.0], [-0.3, 0, 0], 20),
        "floor": rectangle([2, 2], [0, 0, 0], [0, 0, 1], bsdf=grey(0.6)),
        "ball": {"type": "sphere", "center": [0, 0, 1.2], "radius": 0.4, "bsdf": glass},
        "light": {"type": "point", "position": [0.7, 0, 2.8], "intensity": {"type": "rgb", "value": 8.0}},
    }


def bulb(size: int) -> SceneDict:
    """A room lit by a ball in a hollow bulb of glass: no technique joins anything to the light itself."""
    scene = lit_room(size)
    at = [0, 0, 1.2]
    shell = {"type": "dielectric", "int_ior": 1.5}
    cavity = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    scene["light"] = {"type": "sphere", "center": at, "radius": 0.22, "bsdf": grey(0.2), "emitter": shining(6.0)}
    scene["bulb"] = {"type": "sphere", "center": at, "radius": 0.4, "bsdf": shell}
    scene["cavity"] = {"type": "sphere", "center": at, "radius": 0.35, "bsdf": cavity}
    return scene


# ------------------------------------------------ Shapes of lights ------------------------------------------------


def _cube_light(size: int, mirrored: bool) -> SceneDict:
    sign = -1 if mirrored else 1
    scene = lit_room(size)
    to_world = mi.ScalarTransform4f().translate([0.2, 0.1, 1.2]) @ mi.ScalarTransform4f().scale([sign * 0.2, 0.1, 0.3])
    scene["light"] = {"type": "cube", "to_world": to_world, "emitter": shining([6.0, 5.0, 4.0])}
    return scene


def mirrored_light(size: int) -> SceneDict:
    """A room lit by a box whose transformation mirrors it: which side shines?"""
    return _cube_light(size, mirrored=True)


def unmirrored_light(size: int) -> SceneDict:
    """The room of `mirrored_light`, its box not mirrored; as the box is symmetric, the images must be equal."""
    return _cube_light(size, mirrored=False)


def grid_light(size: int) -> SceneDict:
    """A room lit by a flat mesh of 1058 triangles of unequal sizes."""
    scene = lit_room(size)
    scene["light"] = grid("light", 23, emitter=shining([8.0, 7.0, 6.0]))
    return scene


def round_lights(size: int) -> SceneDict:
    """A room lit by a cylinder, a disk and a sphere that is turned."""
    scene = lit_room(size)
    disk = mi.ScalarTransform4f().look_at(origin=[0.95, 0, 1], target=[0, 0, 0.8], up=[0, 0, 1])
    tube = {"type": "cylinder", "p0": [-0.7, 0.4, 1.2], "p1": [-0.2, 0.4, 1.5], "radius": 0.08}
    scene["light"] = {**tube, "emitter": shining([9.0, 2.0, 2.0])}
    scene["disk"] = {"type": "disk", "to_world": disk @ mi.ScalarTransform4f().scale(0.2), "emitter": shining(4.0)}
    ball = mi.ScalarTransform4f().translate([0.4, 0.5, 0.4]).rotate([0.6, 0, 0.8], 160).scale(0.12)
    scene["ball"] = {"type": "sphere", "to_world": ball, "emitter": shining([1.0, 6.0, 2.0])}
    return scene


def smooth_mesh_light(size: int) -> SceneDict:
    """A room lit by an octahedron with smooth normals, where `path` is biased: only hits find it."""
    scene = lit_room(size)
    scene["light"] = octahedron("light", [0, 0, 1.5], 0.35, emitter=shining(8.0))
    return scene


def textured_ball_light(size: int) -> SceneDict:
    """A room lit by a ball whose points Mitsuba samples without their texels: only hits find it."""
    emitter = hard_scenes.textured_light(size)["light"]["emitter"]
    return {**lit_room(size), "light": {"type": "sphere", "center": [0, 0, 1.3], "radius": 0.3, "emitter": emitter}}


def sun_and_sky(size: int) -> SceneDict:
    """A room open to a sky model with its sun, for which `bdpt` has no emission sampling."""
    scene = lit_room(size)
    del scene["light"]
    return {**scene, "sky": {"type": "sunsky", "sun_direction": [0.2, -0.8, 0.5]}}


def projector(size: int) -> SceneDict:
    """A room lit by a projector that throws a pattern of dark and bright texels."""
    pattern = np.random.default_rng(3).uniform(0, 1, (8, 8, 3)).astype(np.float32) ** 3
    to_world = mi.ScalarTransform4f().look_at(origin=[-0.5, -0.8, 1.6], target=[0.2, 0.6, 0.3], up=[0, 0, 1])
    irradiance = {"type": "bitmap", "raw": True, "data": mi.TensorXf(pattern)}
    light = {"type": "projector", "to_world": to_world, "fov": 60, "irradiance": irradiance, "scale": 20.0}
    return {**lit_room(size), "light": light}


# ------------------------------------------------ Rows ------------------------------------------------

_UNGUIDED = tuple(settings for settings in ALL if not settings.guided_light)
"""Settings for a truth that is noisier than guided light paths: a test compares those with other settings instead."""
_INDIRECT = replace(LONG, truth_spp=512)

SCENES = (
    HardScene(6, "rotated-envmap", hard_scenes.rotated_envmap),
    HardScene(6, "constant-sky", hard_scenes.constant_environment, quick=None),
    HardScene(6, "sun-and-sky", sun_and_sky),
    HardScene(
        7,
        "moved-geometry",
        block_at_home,
        rendered("path", "fresh load by `path`", block_far_away),
        max_depth=4,
        edit=move_block,
    ),
    HardScene(11, "cove", hard_scenes.cove, long=_INDIRECT),
    HardScene(
        12,
        "door-gap",
        hard_scenes.door_gap,
        max_depth=8,
        quick=replace(QUICK, truth_spp=512, resolution=0.02),
        long=replace(_INDIRECT, resolution=0.004),
    ),
    HardScene(
        13,
        "glass-caustic",
        hard_scenes.glass_caustic,
        rendered("path", "`path` at very high spp"),
        settings=_UNGUIDED,
        quick=replace(QUICK, seeds=8, spp=256, truth_spp=2048, resolution=0.05),
        long=replace(LONG, size=16, blocks=4, spp=2048, truth_spp=16384, resolution=0.02),
    ),
    HardScene(
        14,
        "point-caustic",
        point_caustic,
        rendered("ptracer", "`ptracer`"),
        settings=WITH_LIGHT_PATHS,
        quick=replace(QUICK, spp=256, truth_spp=512, resolution=0.02),
        long=replace(LONG, resolution=0.01),
    ),
    HardScene(
        15,
        "light-in-bulb",
        bulb,
        max_depth=10,
        quick=replace(QUICK, truth_spp=256, resolution=0.02),
        long=replace(LONG, resolution=0.004),
    ),
    HardScene(16, "mirror-corridor", hard_scenes.mirror_room, max_depth=8, long=replace(LONG, resolution=0.006)),
    HardScene(22, "mirrored-mesh-light", mirrored_light, rendered("path", "`path`, not mirrored", unmirrored_light)),
    HardScene(23, "textured-light", hard_scenes.textured_light),
    HardScene(
        23,
        "textured-ball-light",
        textured_ball_light,
        quick=replace(QUICK, spp=256, resolution=0.02),
        long=replace(LONG, resolution=0.008),
    ),
    HardScene(24, "mesh-light", grid_light),
    HardScene(24, "round-lights", round_lights),
    HardScene(24, "smooth-mesh-light", smooth_mesh_light, rendered("prb_basic", "`prb_basic`: hits alone")),
    HardScene(
        25,
        "hundred-lights-at-once",
        hard_scenes.hundred_lights,
        max_depth=4,
        quick=replace(QUICK, spp=256, truth_spp=1024, resolution=0.03),
        long=replace(LONG, spp=512, truth_spp=2048, resolution=0.01),
    ),
    HardScene(25, "lights-of-every-kind", hard_scenes.many_lights),
    HardScene(26, "projector", projector),
)
"""The scenes of rows 6, 7, 11–16 and 22–26."""
