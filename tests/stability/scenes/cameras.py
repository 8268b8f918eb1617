"""Scenes that are hard because of the camera, the film, or the scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mitsuba as mi

from tests.stability.scenes import hard_scenes
from tests.stability.scenes.case import (
    EYE_ALONE,
    LONG,
    QUICK,
    HardScene,
    Refusal,
    SceneDict,
    crop_of_full_image,
    same_by_bdpt,
)
from tests.stability.scenes.hard_scenes import camera, grey, lit_room, rectangle, shining


def seen_by(**changes: Any) -> Callable[[int], SceneDict]:
    """The room of two-sided sheets, its sensor changed."""

    def build(size: int) -> SceneDict:
        scene = hard_scenes.twosided(size)
        film = {**scene["sensor"]["film"], **changes.get("film", {})}
        scene["sensor"] = {**scene["sensor"], **changes, "film": film}
        return scene

    return build


# ------------------------------------------------ Places of a camera ------------------------------------------------


def camera_in_light(size: int) -> SceneDict:
    """The camera lies in the plane of the light, within it, and looks where that shines: connections of length 0."""
    return {**lit_room(size), "sensor": camera(size, [0.1, 0.05, 1.95], [0.1, 0.3, 0], 60)}


def camera_at_wall(size: int) -> SceneDict:
    """The camera touches a wall and looks along it: splats of huge weight."""
    return {**lit_room(size), "sensor": camera(size, [-0.999, -0.9, 1], [-0.9, 0.9, 0.9], 70, near_clip=1e-3)}


def blocked_before_near_plane(size: int) -> SceneDict:
    """A sheet between the camera and its near plane: it is not seen, and casts no shadow on the lens."""
    scene = {**lit_room(size), "blocker": rectangle([0.5, 0.5], [0, -2.9, 1], [0, -1, 0], bsdf=grey(0.5))}
    scene["sensor"]["near_clip"] = 0.5
    return scene


def light_on_wall(size: int) -> SceneDict:
    """The room of two-sided sheets with its light large on the back wall: something to see at every depth."""
    scene = hard_scenes.twosided(size)
    return {**scene, "light": rectangle([0.6, 0.6], [0, 0.99, 0.9], [0, -1, 0], emitter=shining([3.0, 2.5, 2.0]))}


def orthographic(size: int) -> SceneDict:
    """The room of two-sided sheets without perspective: a camera that light cannot be joined to."""
    scene = hard_scenes.twosided(size)
    sensor = {key: value for key, value in scene["sensor"].items() if key != "fov"}
    to_world = sensor["to_world"] @ mi.ScalarTransform4f().scale([0.8, 0.8, 1])
    return {**scene, "sensor": {**sensor, "type": "orthographic", "to_world": to_world}}


# ------------------------------------------------ Windows ------------------------------------------------

OFFSET = {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1}
LENS = {"type": "thinlens", "aperture_radius": 0.15, "focus_distance": 3.0}
CLIPPED_LENS = {**LENS, "aperture_radius": 0.1, "near_clip": 2.9, "far_clip": 3.6}


def cropped(size: int) -> SceneDict:
    """The room through a crop window off the middle, with the principal point moved."""
    unit = size // 16
    window = {"crop_offset_x": 4, "crop_offset_y": 2, "crop_width": 8, "crop_height": 12}
    return seen_by(**OFFSET, film={key: value * unit for key, value in window.items()})(size)


# ------------------------------------------------ Scale ------------------------------------------------


LENGTH = 100.0
"""The half width of the room at scale 1.

Mitsuba moves the origins of rays by 9e-5 units wherever |p| < 1, so a room of a few millimetres changes by itself: the
cove at half width 1e-3 is brighter by 2.7 % with `path`, too.
"""


def scaled(factor: float) -> Callable[[int], SceneDict]:
    """The cove, everything made larger by this factor."""
    length = LENGTH * factor

    def build(size: int) -> SceneDict:
        scene = hard_scenes.cove(size)
        for entry in scene.values():
            if isinstance(entry, dict) and entry["type"] == "rectangle":
                entry["to_world"] = mi.ScalarTransform4f().scale(length) @ entry["to_world"]
        clip = {"near_clip": 1e-2 * length, "far_clip": 1e2 * length}
        return {**scene, "sensor": camera(size, [0, -3.2 * length, length], [0, 0, length], 40, **clip)}

    return build


# ------------------------------------------------ What is refused ------------------------------------------------


def _fog(size: int) -> SceneDict:
    fog = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    return {**hard_scenes.cove(size), "fog": fog}


REFUSALS = (
    Refusal(30, "gaussian-filter", seen_by(film={"rfilter": {"type": "gaussian"}}), "only the box filter is allowed"),
    Refusal(
        None,
        "orthographic-camera",
        orthographic,
        "light paths can be joined to 'perspective' and 'thinlens'",
        allowed=EYE_ALONE[0],
    ),
    Refusal(None, "medium", _fog, "bounds a participating medium"),
)
"""Row 30, and the other scenes that `bdpt` refuses."""

# ------------------------------------------------ Rows ------------------------------------------------


def _depth(max_depth: int, rr_depth: int) -> HardScene:
    name = f"depth-{'unbounded' if max_depth < 0 else max_depth}-roulette-{rr_depth}"
    shown = (max_depth, rr_depth) in ((1, 1000), (2, 1), (3, 1000), (-1, 1))
    quick = replace(QUICK, truth_spp=256)
    return HardScene(
        35,
        name,
        light_on_wall,
        hard="depth and roulette mean what they mean for `path`",
        max_depth=max_depth,
        rr_depth=rr_depth,
        quick=quick if shown else None,
        long=replace(LONG, size=16, blocks=4),
    )


SCENES = (
    HardScene(27, "camera-in-light", camera_in_light),
    HardScene(27, "camera-at-wall", camera_at_wall, quick=replace(QUICK, resolution=0.02)),
    HardScene(27, "blocker-before-near-plane", blocked_before_near_plane),
    HardScene(28, "thin-lens", seen_by(**LENS), hard="a lens with an area"),
    HardScene(28, "clipped-thin-lens", seen_by(**CLIPPED_LENS), hard="the same with clipping planes in the room"),
    HardScene(28, "orthographic", orthographic, settings=EYE_ALONE, quick_settings=EYE_ALONE),
    HardScene(29, "crop", cropped, crop_of_full_image(seen_by(**OFFSET), slice(2, 14), slice(4, 12))),
    *(
        HardScene(
            32,
            f"scale-{factor:g}",
            scaled(factor),
            same_by_bdpt(scaled(1.0), "the same image at scale 1"),
            hard="lengths that ray offsets and clamps do not expect",
            max_depth=5,
            quick=replace(QUICK, spp=96) if factor > 1 else None,
        )
        for factor in (1e3, 1e-3)
    ),
    # Unbounded paths without any roulette end by themselves in a room that loses light, but late
    *(_depth(max_depth, rr) for max_depth in (1, 2, 3, -1) for rr in (1, 1000 if max_depth > 0 else 50)),
)
"""The scenes of rows 27–29, 32 and 35."""
