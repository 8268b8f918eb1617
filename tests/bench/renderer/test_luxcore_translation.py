"""pyluxcore renders what Mitsuba renders: closed forms, and the same picture the same way up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)
from bench.renderer.peers.luxcore import LuxCoreMethod, installed  # noqa: E402 - after the variant is set
from bench.renderer.peers.luxcore_scene import NotExpressibleError, translate  # noqa: E402
from bench.renderer.peers.methods import MitsubaMethod, integrator  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES, camera, grey, rectangle  # noqa: E402

needs_luxcore = pytest.mark.skipif(not installed(), reason="pyluxcore is not installed: make bench-render installs it")


def rendered(scene: Any, size: int, max_depth: int, spp: int) -> np.ndarray:
    with LuxCoreMethod(translate(scene), size=size, max_depth=max_depth, threads=1) as luxcore:
        return luxcore.render(1, spp).image


def closed_sphere(**more: Any) -> dict[str, Any]:
    sphere = {"type": "sphere", "flip_normals": True, "bsdf": grey(0.5)}
    inside = camera(16, [0.3, 0.2, 0.1], [1, 0, 0], 60, near_clip=1e-3)
    return {"type": "scene", "sensor": inside, "sphere": sphere | more.pop("sphere", {}), **more}


# Closed sphere, Le = ½, ρ = ½, k edges: 1 − ½ᵏ. LuxCore has all paths of up to 8 edges and some of up to 15, so its
# mean lies between 1 − ½⁸ and 1 − ½¹⁵; 0.5 % is above ten standard errors of 4096 samples of nearly no variance.
@needs_luxcore
def test_shining_sphere_seen_from_inside_by_luxcore() -> None:
    light = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.5}}}
    image = rendered(mi.load_dict(closed_sphere(sphere=light)), 16, 8, 16)
    assert 1 - 0.5**8 - 0.005 < image.mean() < 1 + 0.005


# Of all ways to lay one picture upon the other (as it is, mirrored, upside down, a pixel off) the first fits best.
@needs_luxcore
def test_the_picture_is_the_same_way_up_and_not_a_pixel_off() -> None:
    scene = mi.load_dict(HARD_SCENES["cornell"](32), optimize=False)
    theirs, ours = rendered(scene, 32, 2, 64), MitsubaMethod(scene, integrator("path", 2, {})).render(1, 512).image
    ways = {"as it is": ours, "mirrored": ours[:, ::-1], "upside down": ours[::-1]}
    ways |= {f"moved {dy} {dx}": np.roll(ours, (dy, dx), (0, 1)) for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1))}
    misfit = {way: np.minimum(np.abs(theirs - image) / (image + 0.05), 1).mean() for way, image in ways.items()}
    assert min(misfit, key=lambda way: misfit[way]) == "as it is"


# Cornell's box of up to 8 edges. LuxCore's longer paths add about 2 %; a light, a colour or a wall that is not the same
# would show above 6 %. 64 samples of 1024 pixels leave 0.6 %.
@needs_luxcore
def test_cornell_s_box_is_as_bright() -> None:
    scene = mi.load_dict(HARD_SCENES["cornell"](32), optimize=False)
    theirs, ours = rendered(scene, 32, 8, 64), MitsubaMethod(scene, integrator("bdpt", 8, {})).render(1, 256).image
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.06)


def test_matte_has_a_black_back_unless_it_is_twosided() -> None:
    sheet = rectangle([1, 1], [0, 0, 0], [0, 0, 1], bsdf=grey(0.6))
    both = rectangle([1, 1], [0, 0, 1], [0, 0, 1], bsdf={"type": "twosided", "b": grey(0.5)})
    scene = mi.load_dict({"type": "scene", "sensor": camera(8, [0, -3, 1], [0, 0, 1], 40), "a": sheet, "b": both})
    found = translate(scene).properties
    backs = sorted(found[key] for key in found if key.endswith("backmaterial"))
    assert backs[0] == "black"
    assert found[f"scene.materials.{backs[1]}.kd"] == pytest.approx([0.5] * 3)


@pytest.mark.parametrize("facing", [[0, 0, 1], [0, 0, -1], [1, 0, 0]])
def test_triangles_turn_as_their_light_shines(facing: list[int]) -> None:
    light = rectangle([1, 2], [0, 0, 0], facing, emitter={"type": "area", "radiance": {"type": "rgb", "value": 1.0}})
    translated = translate(mi.load_dict({"type": "scene", "sensor": camera(8, [0, -3, 1], [0, 0, 1], 40), "a": light}))
    corners = translated.meshes["s0.vertices"][translated.meshes["s0.faces"]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(normals @ np.array(facing) > 0)


@pytest.mark.parametrize("name", ["rotated_envmap", "plastics", "textured_light", "bump_floor", "mask"])
def test_what_luxcore_cannot_express_is_refused(name: str) -> None:
    with pytest.raises(NotExpressibleError):
        translate(mi.load_dict(HARD_SCENES[name](16), optimize=False))
