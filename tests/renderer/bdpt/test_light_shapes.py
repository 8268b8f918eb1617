"""Lights whose shapes Mitsuba samples wrongly."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.emission import read_lights, sample_emission
from photonfarm.renderer.verify.scenes import hard_scenes

BDPT = {"type": "bdpt", "max_depth": 4}


def turned_ball(*scale: float) -> Any:
    to_world = mi.ScalarTransform4f().translate([0.1, 0.2, 1.2]).rotate([0.6, 0, 0.8], 160).scale([*scale])
    return {"type": "sphere", "to_world": to_world, "emitter": hard_scenes.shining(8.0)}


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


@pytest.mark.parametrize("guided", [False, True])
def test_a_turned_sphere_lights_as_much_by_light_paths(guided: bool, renders: Any, assert_equal_means: Any) -> None:
    scene = mi.load_dict({**hard_scenes.lit_room(16), "light": turned_ball(0.2, 0.2, 0.2)}, optimize=False)
    images = renders(scene, {**BDPT, "guided_light": guided, "record": True}, 128, range(8))
    assert_equal_means(images, renders(scene, {"type": "path", "max_depth": 4}, 512, range(100, 108)))
