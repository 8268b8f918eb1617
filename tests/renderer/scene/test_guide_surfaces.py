"""Guides of materials, and of what surfaces show and reflect, against formulas."""

import numpy as np
import pytest
from guide_scenes import (
    AHEAD,
    GREY,
    HEIGHT,
    WIDTH,
    Images,
    Shape,
    centre,
    diffuse,
    grid_rays,
    known,
    mi,
    rgb,
    scene_of,
    spec,
    square,
)
from numpy.typing import NDArray

from photonfarm.core.records import Guides, arrays_of
from photonfarm.renderer.scene import guides
from photonfarm.renderer.scene.gbuffer import view_buffers
from photonfarm.renderer.scene.materials import Materials
from photonfarm.scene.view import View

# ------------------------------------------------------------------------------------------------------------ materials


def bumped(bsdf: Shape) -> Shape:
    heights = mi.TensorXf(np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4, 1))
    return {"type": "bumpmap", "texture": {"type": "bitmap", "raw": True, "data": heights}, "bsdf": bsdf}


def of_material(bsdf: Shape) -> Guides:
    return known(scene_of(wall=square((0, 0, 0), (0, 0, 1), 2, bsdf=bsdf)))


def test_specular_is_the_fresnel_reflectance_of_a_conductor_that_of_its_coat_on_plastic_and_0_of_a_diffuse_wall() -> (
    None
):
    found = of_material({"type": "conductor", "eta": 0.3, "k": 3.0})
    _, rays = grid_rays(AHEAD, spec())
    cosine = -rays.reshape(-1, 3) @ np.array([0, 0, -1.0]) * -1
    reflected = np.array(mi.fresnel_conductor(mi.Float(np.abs(cosine).astype(np.float32)), mi.Complex2f(0.3, 3.0)))
    expected = reflected.reshape(HEIGHT, WIDTH, -1).mean(axis=-1)
    np.testing.assert_allclose(found.specular, np.repeat(expected[..., None], 3, axis=-1), rtol=1e-4)
    coat = of_material({"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": rgb(np.zeros(3))})
    np.testing.assert_allclose(centre(coat.specular), 0.04, rtol=0.1)
    assert not of_material(diffuse()).specular.any()
    np.testing.assert_allclose(centre(of_material({"type": "dielectric"}).specular), 1, rtol=1e-4)


WHITE = 0.9 * np.ones(3)
COATED: dict[str, Shape] = {
    "plastic": {"type": "plastic", "diffuse_reflectance": rgb(WHITE)},
    "nonlinear": {"type": "plastic", "diffuse_reflectance": rgb(GREY), "nonlinear": True},
    "twosided": {"type": "twosided", "bsdf": {"type": "plastic", "diffuse_reflectance": rgb(GREY)}},
}


def of_a_ball(bsdf: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What is specular of a ball of radius 1, and the cosine of each ray to its normal (N, 16): where pixels show it.

    The ray from (0, 0, 3) passes the middle at a distance of 3 sin a, which is the sine at the surface.
    """
    found = known(scene_of(ball={"type": "sphere", "bsdf": bsdf})).specular
    sine = 3 * np.sqrt(1 - grid_rays(AHEAD, spec())[1][..., 2] ** 2)
    shown = (sine < 0.999).all(axis=-1)
    assert shown.sum() > 100
    return found[shown].astype(np.float64), np.sqrt(1 - sine[shown] ** 2)


@pytest.mark.parametrize("name", COATED)
def test_specular_of_a_plastic_ball_is_the_fresnel_reflectance_of_its_coat_whatever_lies_below(name: str) -> None:
    found, cosine = of_a_ball(COATED[name])
    eta = 1.49 / 1.000277
    below = np.sqrt(1 - (1 - cosine**2) / eta**2)
    across, along = (cosine - eta * below) / (cosine + eta * below), (eta * cosine - below) / (eta * cosine + below)
    expected = ((across**2 + along**2) / 2).mean(axis=1)
    np.testing.assert_allclose(found, np.repeat(expected[:, None], 3, axis=1), rtol=2e-3)
    assert ((eta - 1) / (eta + 1)) ** 2 < found.min() * 1.001
    assert found.max() < 1


def test_specular_of_principled_materials_is_without_their_diffuse_lobe_and_that_of_metal_is_whole() -> None:
    """It answers with all of its lobes whatever is asked for."""
    dull, metal = ({"type": "principled", "base_color": rgb(GREY), "metallic": share} for share in (0.0, 1.0))
    assert 0.02 < centre(of_material(dull).specular).min() < centre(of_material(dull).specular).max() < 0.1
    np.testing.assert_allclose(centre(of_material(metal).specular), GREY, rtol=0.1)
    np.testing.assert_allclose(centre(of_material({"type": "twosided", "bsdf": metal}).specular), GREY, rtol=0.1)


def test_specular_of_a_mask_counts_what_it_lets_through_and_of_a_blend_each_part() -> None:
    """Lobes are chosen by chance, with 32 samples in each pixel; the mean is over all pixels."""
    masked = of_material({"type": "mask", "opacity": 0.6, "bsdf": COATED["plastic"]}).specular.mean()
    blended = of_material({"type": "blendbsdf", "weight": 0.25, "a": diffuse(), "b": {"type": "conductor"}}).specular
    assert masked == pytest.approx(0.4 + 0.6 * 0.039, abs=0.02)
    assert blended.mean() == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    ("bsdf", "alpha"),
    [
        (diffuse(), 1),
        ({"type": "plastic"}, 1),
        ({"type": "conductor"}, 0),
        ({"type": "dielectric"}, 0),
        ({"type": "thindielectric"}, 0),
        ({"type": "null"}, 0),
        ({"type": "roughconductor", "alpha": 0.1}, 0.1),
        ({"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.3}, 0.2),
        ({"type": "roughdielectric", "alpha": 0.05}, 0.05),
        ({"type": "roughplastic", "alpha": 0.2}, 0.2),
        ({"type": "principled", "roughness": 0.5}, 0.25),
        ({"type": "principled", "roughness": 0.3, "clearcoat": 0.5, "clearcoat_gloss": 0.1}, 0.09),
        ({"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}}, 0.3),
        (bumped({"type": "roughplastic", "alpha": 0.4}), 0.4),
        ({"type": "twosided", "bsdf": bumped({"type": "roughplastic", "alpha": 0.15})}, 0.15),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_roughness_is_the_alpha_that_a_material_states(bsdf: Shape, alpha: float) -> None:
    scene = scene_of(wall=square((0, 0, 0), (0, 0, 1), 2, bsdf=bsdf))
    assert sorted({*Materials.of(scene).roughness.tolist()} - {1.0}) == pytest.approx(sorted({alpha} - {1}), abs=1e-6)
    if bsdf["type"] in ("roughplastic", "twosided", "null"):
        assert centre(known(scene).roughness) == pytest.approx(alpha, abs=1e-6)


def test_roughness_and_gloss_of_a_pixel_are_means_over_what_it_shows() -> None:
    """3 of 4 rays along an axis meet the wall at its edge."""
    distance = 12 / np.tan(np.radians(20)) / 6.705
    view = View(np.array([0, 0, distance], np.float32), np.zeros(3, np.float32))
    wall = square((0, 0, 0), (0, 0, 1), 1, bsdf={"type": "roughconductor", "alpha": 0.4, "eta": 0.3, "k": 3.0})
    found = known(scene_of(wall=wall), view)
    assert found.roughness[8, 5] == pytest.approx(0.75 * 0.4, abs=1e-6)
    np.testing.assert_allclose(found.specular[8, 5], 0.75 * centre(found.specular), rtol=0.1)
    assert found.mean_depth[8, 5] == pytest.approx(distance, abs=1e-4), "of the rays that meet it"
    np.testing.assert_allclose(found.mean_normal[8, 5], (0, 0, 0.75), atol=1e-6)


# ---------------------------------------------------------------------------------------------------- shape, and beyond


def test_beyond_a_mirror_lies_the_wall_that_it_shows() -> None:
    """Along the path from (0, 0, 3) by z = 0 to z = 6: 9 over the cosine; half of the wall is grey, half black."""
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 20).scale(5)
    texture = {"type": "checkerboard", "color0": rgb(np.zeros(3)), "color1": rgb(GREY), "to_uv": turned}
    wall = square((0, 0, 6), (0, 0, -1), 8, bsdf={"type": "diffuse", "reflectance": texture})
    mirror = square((0, 0, 0), (0, 0, 1), 3, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)})
    found = known(scene_of(mirror=mirror, wall=wall))
    _, rays = grid_rays(AHEAD, spec())
    cosine = -rays[..., 2]
    np.testing.assert_allclose(found.beyond_depth, (9 / cosine).mean(axis=-1), rtol=1e-4)
    np.testing.assert_allclose(found.beyond_normal, np.broadcast_to([0, 0, -1], (HEIGHT, WIDTH, 3)), atol=1e-6)
    np.testing.assert_allclose(found.throughput, np.broadcast_to(GREY, (HEIGHT, WIDTH, 3)), rtol=1e-5)
    np.testing.assert_allclose(found.mean_depth, 3, rtol=1e-5)
    assert not found.direct.any()

    virtual = View(np.array([0, 0, -3], np.float32), np.zeros(3, np.float32))  # the mirror image of the camera
    behind = view_buffers(scene_of(wall=wall), [virtual], spec())[0].albedo[:, ::-1]
    np.testing.assert_allclose(found.beyond_albedo, behind, atol=1e-6)
    assert 0.2 < (found.beyond_albedo.mean() / GREY.mean()) < 0.8
    assert len(np.unique(found.beyond_albedo[..., 0].round(4))) > 2, "the mean over pixels at edges of the texture"


@pytest.mark.parametrize(
    ("bsdf", "albedo"),
    [
        (diffuse(), np.zeros(3)),
        ({"type": "twosided", "bsdf": diffuse()}, GREY),
        ({"type": "principled", "base_color": rgb(GREY)}, GREY),
        ({"type": "mask", "opacity": 0.5, "bsdf": diffuse()}, GREY),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_the_back_of_a_one_sided_wall_in_a_mirror_is_black(bsdf: Shape, albedo: Images) -> None:
    """That of a principled one and of a mask, which Mitsuba flags as two-sided, has the albedo of its front."""
    mirror = square((0, 0, 0), (0, 0, 1), 3, bsdf={"type": "conductor"})
    found = known(scene_of(mirror=mirror, wall=square((0, 0, 6), (0, 0, 1), 8, bsdf=bsdf)))
    np.testing.assert_allclose(centre(found.beyond_albedo), albedo, atol=1e-6)
    assert centre(found.beyond_depth) == pytest.approx(9, rel=1e-2)


def test_two_mirrors_that_face_each_other_end_after_so_many() -> None:
    scene = scene_of(
        front=square((0, 0, 0), (0, 0, 1), 20, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)}),
        back=square((0, 0, 4), (0, 0, -1), 20, bsdf={"type": "conductor"}),
    )
    found = known(scene)
    np.testing.assert_allclose(centre(found.throughput), GREY ** (guides.FOLLOWED / 2), rtol=1e-4)
    assert all(np.isfinite(values).all() for values in arrays_of(found).values())
