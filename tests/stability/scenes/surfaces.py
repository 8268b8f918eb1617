"""Scenes that are hard because of their surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi
import numpy as np

from tests.stability.scenes import hard_scenes
from tests.stability.scenes.case import LONG, QUICK, HardScene, SceneDict
from tests.stability.scenes.closed_form import point_in_sphere
from tests.stability.scenes.hard_scenes import bumps, grey, lit_room, rectangle
from tests.stability.scenes.meshes import smooth_ball


def glass_plate(size: int) -> SceneDict:
    """The lit room behind a thick plate of glass, through which nothing joins the camera."""
    plate = mi.ScalarTransform4f().translate([0, -2, 1]) @ mi.ScalarTransform4f().scale([2, 0.1, 2])
    return {**lit_room(size), "plate": {"type": "cube", "to_world": plate, "bsdf": {"type": "dielectric"}}}


def null_veils(size: int) -> SceneDict:
    """Sheets that are not there (`null`), before light and camera: next event estimation stops at them."""
    return {
        **lit_room(size),
        "light_veil": rectangle([0.5, 0.5], [0, 0, 1.7], [0, 0, -1], bsdf={"type": "null"}),
        "camera_veil": rectangle([0.6, 0.6], [0, -1.5, 1], [0, -1, 0], bsdf={"type": "null"}),
    }


def smooth_balls(size: int) -> SceneDict:
    """Two coarse balls with smooth normals, one-sided and two-sided."""
    metal = {"type": "twosided", "b": {"type": "roughconductor", "alpha": 0.3}}
    return {
        **lit_room(size),
        "one": smooth_ball("one", [-0.5, 0, 0.6], 0.4, bsdf=grey(0.7)),
        "two": smooth_ball("two", [0.5, 0, 0.6], 0.4, bsdf=metal),
    }


def bumped_sphere(size: int) -> SceneDict:
    """The closed sphere with a point light, strongly bump-mapped: weights of long paths must not spike."""
    scene = point_in_sphere(size)
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(bumps())}
    scene["sphere"]["bsdf"] = {"type": "bumpmap", "texture": texture, "scale": 0.5, "bsdf": grey(0.5)}
    return scene


def touching(size: int) -> SceneDict:
    """Boxes that share edges, corners and faces with each other and the room, a floor that is there twice."""
    scene = lit_room(size)
    scene["floor_again"] = rectangle([1, 1], [0, 0, 0], [0, 0, 1], bsdf=grey(0.6))
    for k, at in enumerate(([-0.7, 0.7, 0.3], [-0.1, 0.1, 0.3], [-0.1, 0.7, 0.9], [0.5, 0.1, 0.3])):
        to_world = mi.ScalarTransform4f().translate(at) @ mi.ScalarTransform4f().scale(0.3)
        scene[f"box{k}"] = {"type": "cube", "to_world": to_world, "bsdf": grey(0.5)}
    return scene


def rough_glass(alpha: float) -> Callable[[int], SceneDict]:
    """A ball of rough glass of this roughness in the lit room."""

    def build(size: int) -> SceneDict:
        scene = hard_scenes.rough_dielectric(size)
        scene["ball"]["bsdf"]["alpha"] = alpha
        return scene

    return build


def _balls(size: int, **bsdfs: SceneDict) -> SceneDict:
    scene = lit_room(size)
    for k, (name, bsdf) in enumerate(bsdfs.items()):
        x = -0.66 + 1.32 * k / max(len(bsdfs) - 1, 1)
        scene[name] = {"type": "sphere", "center": [x, 0, 0.4], "radius": 0.28, "bsdf": bsdf}
    return scene


def rough_surfaces(size: int) -> SceneDict:
    """Rough plastic, anisotropic metal, a mirror of gold, a normal-mapped metal."""
    texels = np.random.default_rng(2).uniform(0.35, 0.65, (8, 8, 3)).astype(np.float32)
    texels[..., 2] = 1
    mapped = {
        "type": "normalmap",
        "normalmap": {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels)},
        "bsdf": {"type": "roughconductor", "alpha": 0.3},
    }
    return _balls(
        size,
        plastic={
            "type": "roughplastic",
            "alpha": 0.1,
            "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.2, 0.1]},
        },
        metal={"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4, "material": "Al"},
        gold={"type": "conductor", "material": "Au"},
        mapped=mapped,
    )


def sheets(size: int) -> SceneDict:
    """Thin things: a pane, a thin principled sheet, a cut-out with holes, a blend of two."""
    holes = (np.indices((8, 8)).sum(axis=0) % 2).astype(np.float32)[..., None]
    opacity = {"type": "bitmap", "raw": True, "filter_type": "nearest", "data": mi.TensorXf(holes)}
    cut_out = {"type": "mask", "opacity": opacity, "bsdf": {"type": "twosided", "b": grey(0.7)}}
    thin = {"type": "principledthin", "diff_trans": 0.8, "spec_trans": 0.3, "roughness": 0.3, "eta": 1.3}
    blend = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "roughplastic"}, "b": {"type": "roughconductor"}}
    return {
        **lit_room(size),
        "pane": rectangle([0.3, 0.3], [-0.6, 0, 0.5], [0.3, -1, 0.1], bsdf={"type": "thindielectric"}),
        "thin": rectangle([0.3, 0.3], [0.1, 0, 0.5], [-0.2, -1, 0.3], bsdf=thin),
        "cut_out": rectangle([0.3, 0.3], [0.6, 0.3, 0.6], [-0.4, -1, 0.2], bsdf=cut_out),
        "blend": rectangle([0.3, 0.3], [0, 0.5, 1.3], [0, -1, -0.5], bsdf={"type": "twosided", "b": blend}),
    }


# ------------------------------------------------ Rows ------------------------------------------------

SCENES = (
    HardScene(17, "glass-plate", glass_plate, max_depth=8),
    HardScene(
        18,
        "mask-veils",
        hard_scenes.mask,
        quick=replace(QUICK, spp=256, truth_spp=1024),
        long=replace(LONG, resolution=0.008),
    ),
    HardScene(
        18, "null-veils", null_veils, quick=replace(QUICK, spp=128, truth_spp=512), long=replace(LONG, resolution=0.006)
    ),
    HardScene(19, "normal-floor", hard_scenes.normal_floor),
    HardScene(19, "bump-floor", hard_scenes.bump_floor),
    HardScene(20, "smooth-balls", smooth_balls),
    HardScene(20, "twosided-sheets", hard_scenes.twosided, quick=None),
    HardScene(21, "bumped-sphere", bumped_sphere, max_depth=12, max_over_mean=3.0),
    HardScene(31, "touching", touching),
    *(
        HardScene(
            33,
            f"rough-glass-{alpha:g}",
            rough_glass(alpha),
            hard="lobes from almost a point to almost diffuse, both ways through",
            max_depth=8,
            long=replace(LONG, resolution=0.005),
            quick=replace(QUICK, resolution=0.02) if alpha != 0.05 else None,
        )
        for alpha in (0.001, 0.05, 0.5)
    ),
    HardScene(34, "plastics", hard_scenes.plastics),
    HardScene(34, "rough-surfaces", rough_surfaces),
    HardScene(34, "sheets", sheets),
)
"""The scenes of rows 17–21, 31, 33 and 34."""
