"""Lights whose shapes Mitsuba samples wrongly, or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.lights.emission import read_lights, sample_emission
from photonfarm.renderer.bdpt.lights.selection import is_unfolded
from tests.stability.scenes import hard_scenes
from tests.stability.scenes.lights import round_lights

BDPT = {"type": "bdpt", "max_depth": 4}


def turned_ball(*scale: float) -> Any:
    to_world = mi.ScalarTransform4f().translate([0.1, 0.2, 1.2]).rotate([0.6, 0, 0.8], 160).scale([*scale])
    return {"type": "sphere", "to_world": to_world, "emitter": hard_scenes.shining(8.0)}


def texels() -> dict[str, Any]:
    bitmap = mi.Bitmap((np.random.default_rng(0).random((4, 4, 3)) * 9).astype(np.float32))
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}


# ------------------------------------------------ Spheres ------------------------------------------------


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("scale", [(0.2, 0.2, 0.2), (-0.2, 0.2, 0.2)], ids=["turned", "mirrored"])
def test_light_leaves_a_turned_sphere_on_the_side_that_is_seen_to_shine(scale: Any, flipped: bool) -> None:
    """Mitsuba's normals of sampled points once were those of a sphere that is not turned: light was lost."""
    scene = mi.load_dict({"type": "scene", "ball": {**turned_ball(*scale), "flip_normals": flipped}}, optimize=False)
    lights, paths = read_lights(scene), 4096
    path = dr.arange(mi.UInt32, paths)
    sequence = randomness.stream(randomness.image_keys([1]), randomness.LIGHT) + dr.zeros(mi.UInt32, paths)
    start = sample_emission(lights, randomness.sampler(sequence, path), path, dr.opaque(mi.UInt32, paths))
    outwards = dr.normalize(start.sample.p - mi.Point3f(0.1, 0.2, 1.2))
    above = mi.Point3f(start.sample.p + 0.02 * start.sample.n)
    found = scene.ray_intersect(mi.Ray3f(above, -start.sample.n))
    assert np.array(start.valid).all()
    np.testing.assert_allclose(np.abs(np.array(dr.dot(start.sample.n, outwards))), 1, atol=1e-4)
    np.testing.assert_allclose(np.array(dr.dot(start.sample.n, found.n)), 1, atol=1e-4)


# ------------------------------------------------ Cylinders ------------------------------------------------


@pytest.mark.parametrize(
    ("scale", "flipped"), [((0.2, 0.2, 0.3), False), ((-0.2, 0.2, 0.3), False), ((0.2, 0.2, -0.3), True)]
)
def test_a_mirrored_cylinder_lights_as_much_as_its_hits(
    scale: Any, flipped: bool, renders: Any, assert_equal_means: Any
) -> None:
    """Mitsuba's sampled points of a mirrored cylinder have normals opposite to those of its hits: `path` is biased."""

    def room(**more: Any) -> Any:
        to_world = mi.ScalarTransform4f().translate([0.1, 0.2, 1.2]).scale([*scale])
        emitter = {**hard_scenes.shining(8.0), **more}
        tube = {"type": "cylinder", "to_world": to_world, "flip_normals": flipped, "emitter": emitter}
        dark = {"type": "point", "position": [0, 0, 1], "intensity": 0.0}  # Mitsuba wants some light to sample
        return mi.load_dict({**hard_scenes.lit_room(16), "light": tube, "dark": dark}, optimize=False)

    hits = renders(room(sampling_weight=0.0), {"type": "path", "max_depth": 4}, 1024, range(100, 108))
    assert_equal_means(renders(room(), BDPT, 256, range(8)), hits)


# ------------------------------------------------ Textured meshes ------------------------------------------------


def sheet(file: Path, texture_scale: float) -> dict[str, Any]:
    """A square mesh light below the ceiling, whose texture is repeated where the scale is above 1."""
    mesh = mi.Mesh("sheet", 4, 2, has_vertex_texcoords=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-0.3, -0.3, 1.5, -0.3, 0.3, 1.5, 0.3, 0.3, 1.5, 0.3, -0.3, 1.5]
    parameters["faces"] = [0, 1, 2, 0, 2, 3]
    parameters["vertex_texcoords"] = [texture_scale * x for x in (0, 0, 0, 1, 1, 1, 1, 0)]
    parameters.update()
    mesh.write_ply(str(file))
    return {"type": "ply", "filename": str(file), "face_normals": True, "emitter": texels()}


@pytest.mark.parametrize(("texture_scale", "found"), [(1.0, True), (3.0, False)])
def test_texels_that_repeat_do_not_say_where_a_point_lies(texture_scale: float, found: bool, tmp_path: Path) -> None:
    mesh = mi.load_dict(sheet(tmp_path / "sheet.ply", texture_scale))
    assert bool(is_unfolded(mesh)[0]) is found


def test_faces_that_share_their_texels_are_lights_for_hits_alone(renders: Any, assert_equal_means: Any) -> None:
    """All faces of Mitsuba's cube have the same texture: by its texels, and so by `path`, only one is sampled."""

    def cube(**more: Any) -> Any:
        to_world = mi.ScalarTransform4f().translate([0.1, 0.2, 1.2]).scale(0.2)
        light = {"type": "cube", "to_world": to_world, "face_normals": True, "emitter": {**texels(), **more}}
        dark = {"type": "point", "position": [0, 0, 1], "intensity": 0.0}  # Mitsuba wants some light to sample
        return mi.load_dict({**hard_scenes.lit_room(16), "light": light, "dark": dark}, optimize=False)

    hits = renders(cube(sampling_weight=0.0), {"type": "path", "max_depth": 4}, 2048, range(100, 108))
    assert_equal_means(renders(cube(), BDPT, 512, range(8)), hits)


# ------------------------------------------------ Curves ------------------------------------------------


@pytest.mark.parametrize("kind", ["bsplinecurve", "linearcurve"])
def test_curves_beside_area_lights_are_refused_where_light_paths_start(kind: str, tmp_path: Path) -> None:
    (tmp_path / "curve.txt").write_text("\n".join(f"{x} {x * x} 0.5 0.05" for x in (-0.4, -0.1, 0.1, 0.4)))
    curve = {"type": kind, "filename": str(tmp_path / "curve.txt")}
    scene = mi.load_dict({**round_lights(8), "hair": curve}, optimize=False)
    with pytest.raises(ValueError, match="shape 'hair', a curve; light paths cannot start"):
        mi.load_dict(BDPT).render(scene, spp=1)
    plain = mi.load_dict({**BDPT, "connections": 0, "light_ratio": 0})
    assert np.isfinite(np.array(plain.render(scene, spp=1))).all()
