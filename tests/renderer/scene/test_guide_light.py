"""Emission and direct light of guides, against formulas and against Mitsuba's path tracer."""

from typing import Any

import numpy as np
import pytest
from guide_scenes import (
    BLACK,
    GREY,
    KEY,
    RADIANCE,
    Images,
    Shape,
    centre,
    diffuse,
    grid_rays,
    known,
    lamp,
    mi,
    of_keys,
    rgb,
    scene_of,
    some_keys,
    spec,
    square,
)
from numpy.typing import NDArray

from photonfarm.core.keys import make_key
from photonfarm.core.records import arrays_of
from photonfarm.core.statistics import block_z_test
from photonfarm.renderer.bdpt.lights.emission import read_lights
from photonfarm.renderer.scene.guides import point_light
from photonfarm.renderer.scene.view_rays import GRID
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.view import View

# ------------------------------------------------------------------------------------------------------------- emission


def test_a_lamp_is_seen_with_its_radiance_and_by_its_share_of_a_pixel() -> None:
    """It ends 12 / tan 20° / d = 6.705 pixels from the middle: 3 of 4 rays along an axis meet it there."""
    distance = 12 / np.tan(np.radians(20)) / 6.705
    view = View(np.array([0, 0, distance], np.float32), np.zeros(3, np.float32))
    emission = known(scene_of(lamp=lamp((0, 0, 0), (0, 0, 1), 1)), view).emission
    np.testing.assert_allclose(centre(emission), RADIANCE, rtol=1e-6)
    np.testing.assert_allclose(emission[8, 5], 0.75 * RADIANCE, rtol=1e-6)
    np.testing.assert_allclose(emission[1, 5], 0.75**2 * RADIANCE, rtol=1e-6)
    assert not emission[8, 4].any()


def test_a_lamp_in_a_mirror_has_its_radiance_times_the_reflectance() -> None:
    mirror = square((0, 0, 0), (0, 0, 1), 1, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)})
    scene = scene_of(mirror=mirror, lamp=lamp((0, 0, 5), (0, 0, -1), 20))
    found = known(scene)
    np.testing.assert_allclose(centre(found.emission), GREY * RADIANCE, rtol=1e-5)
    assert not known(scene, transport={"max_depth": 1}).emission[8, 12].any(), "its path has two edges"
    np.testing.assert_allclose(known(scene, transport={"max_depth": -1}).emission, found.emission)


def test_a_lamp_behind_thin_glass_has_what_the_pane_lets_through() -> None:
    """The glass has n = 1.5, head-on: 1 − R at each face, and all reflections between: 1 − 2R / (1 + R), R = 0.04."""
    pane = square((0, 0, 1), (0, 0, 1), 2, bsdf={"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0})
    found = known(scene_of(pane=pane, lamp=lamp((0, 0, 0), (0, 0, 1), 1)))
    passes = 1 - 2 * 0.04 / 1.04
    np.testing.assert_allclose(centre(found.emission), passes * RADIANCE, rtol=1e-3)
    np.testing.assert_allclose(centre(found.throughput), passes, rtol=1e-3)
    np.testing.assert_allclose(centre(found.beyond_depth), 3, rtol=1e-3)


def test_a_lamp_is_reflected_by_glass_that_lets_most_light_through() -> None:
    """Head-on a face with n = 1.5 reflects R = 0.04, and a thin pane, by all reflections within it, 2R / (1 + R)."""
    kinds = {"dielectric": 0.04, "thindielectric": 2 * 0.04 / 1.04}
    for kind, reflected in kinds.items():
        pane = square((0, 0, 0), (0, 0, 1), 2, bsdf={"type": kind, "int_ior": 1.5, "ext_ior": 1.0})
        scene = scene_of(pane=pane, lamp=lamp((0, 0, 5), (0, 0, -1), 20))
        found = known(scene, lights_in_glass=True)
        np.testing.assert_allclose(centre(found.emission), reflected * RADIANCE, rtol=1e-3)
        short = known(scene, lights_in_glass=True, transport={"max_depth": 1})
        assert not short.emission[8, 12].any(), "its path has two edges"
        assert not known(scene).emission[8, 12].any()


def test_a_lamp_is_seen_through_a_mirror_with_holes() -> None:
    """It covers 0.7 of its surface, and so is what is followed."""
    holes = {"type": "mask", "opacity": 0.7, "bsdf": {"type": "conductor", "specular_reflectance": rgb(GREY)}}
    scene = scene_of(pane=square((0, 0, 0), (0, 0, 1), 2, bsdf=holes), lamp=lamp((0, 0, -2), (0, 0, 1), 20))
    np.testing.assert_allclose(centre(known(scene, lights_in_glass=True).emission), 0.3 * RADIANCE, rtol=1e-5)
    assert not known(scene).emission.any()


def test_what_surrounds_the_scene_is_seen_where_nothing_else_is_and_in_mirrors() -> None:
    sky = {"type": "constant", "radiance": rgb(RADIANCE)}
    mirror = square((0, 0, 0), (0, 0, 1), 0.5, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)})
    found = known(scene_of(mirror=mirror, sky=sky))
    np.testing.assert_allclose(found.emission[0, 0], RADIANCE, rtol=1e-6)
    np.testing.assert_allclose(centre(found.emission), GREY * RADIANCE, rtol=1e-6)
    for name, values in arrays_of(found).items():
        assert name in ("emission", "point_light") or not values[0, 0].any(), name


# --------------------------------------------------------------------------------------------------------- direct light

DOWN, UP = (0, -1, 0), (0, 1, 0)
ABOVE = View(np.array([0, 1.2, 4], np.float32), np.array([0, 0.2, 0], np.float32))
LAMP = ((0.0, 1.5, 0.0), 0.25)  # its middle, and half its side
SCREEN = (0.35, 0.7, 0.0), 0.2  # between lamp and floor


def floor_and_lamp(**more: Shape) -> Any:
    floor = square((0, 0, 0), UP, 3, bsdf=diffuse())
    screen = square(*SCREEN[:1], DOWN, SCREEN[1], bsdf={"type": "twosided", "bsdf": BLACK})
    return scene_of(floor=floor, screen=screen, lamp=lamp(LAMP[0], DOWN, LAMP[1]), **more)


def irradiance(place: Images, steps: int) -> Images:
    """The irradiance of points (N, 3) of the floor over the radiance, (N,): a sum over the lamp's unscreened points."""
    across = LAMP[1] * (2 * (np.arange(steps) + 0.5) / steps - 1)
    height = LAMP[0][1]
    total = np.zeros(len(place))
    for x in across:
        for z in across:
            to = np.array([x, height, z]) - place
            squared = (to**2).sum(axis=1)
            at_screen = place + to * (SCREEN[0][1] / height)
            hidden = (np.abs(at_screen[:, [0, 2]] - np.array(SCREEN[0])[[0, 2]]) < SCREEN[1]).all(axis=1)
            total += np.where(hidden, 0, height**2 / squared**2)  # both cosines are height over distance
    return total * (2 * LAMP[1] / steps) ** 2


def on_the_floor(view: View, of: SceneSpec) -> tuple[Images, NDArray[np.bool_]]:
    """The points where each pixel's rays meet the floor, (H, W, 16, 3), and which pixels see nothing else, (H, W)."""
    eye, rays = grid_rays(view, of)
    distance = np.where(rays[..., 1] < 0, -eye[1] / rays[..., 1], np.inf)
    with np.errstate(invalid="ignore"):
        place = eye + rays * distance[..., None]
        at_screen = eye + rays * ((SCREEN[0][1] - eye[1]) / rays[..., 1])[..., None]
        over_screen = (np.abs(at_screen[..., [0, 2]] - np.array(SCREEN[0])[[0, 2]]) < SCREEN[1] + 0.01).all(axis=-1)
        sees = (np.abs(place[..., [0, 2]]) < 2.9).all(axis=-1) & ~(over_screen & (rays[..., 1] < 0))
    return place, sees.all(axis=-1)


def test_direct_light_of_a_lamp_is_its_form_factor_with_shadow_within_the_standard_error() -> None:
    """|z| < 5 in each of some 300 pixels and channels; with other keys, 1 in 3000 runs would fail."""
    scene, of = floor_and_lamp(), spec(16, 16)
    found = np.stack([each.direct for each in of_keys(scene, ABOVE, some_keys(32), 3, width=16, height=16)])
    place, sees = on_the_floor(ABOVE, of)
    light = irradiance(place[sees].reshape(-1, 3), 40).reshape(-1, GRID * GRID).mean(axis=1)
    assert sees.sum() > 60
    truth = GREY / np.pi * RADIANCE * light[:, None]
    mean, error = (found[:, sees].mean(axis=0), found[:, sees].std(axis=0, ddof=1) / np.sqrt(len(found)))
    z = (mean - truth) / np.maximum(error, 1e-4 * truth.max())
    assert np.abs(z).max() < 5
    assert mean.sum() == pytest.approx(truth.sum(), rel=3e-3)
    noise = (found[0][sees] - truth) / truth.mean()
    assert 0.001 < np.sqrt((noise**2).mean()) < 0.1, "one view's, of 48 shadow rays"


def test_the_irradiance_of_points_is_that_of_the_formula_and_none_on_the_side_away_from_the_light() -> None:
    scene = floor_and_lamp()
    place = np.array([[x, 0, z] for x in np.linspace(-2, 2, 9) for z in (-0.5, 0.3)], np.float32)
    normal = np.zeros_like(place) + np.array(UP, np.float32)
    keys = [make_key("points", i) for i in range(64)]
    lights = read_lights(scene)
    found = point_light(scene, lights, place, normal, keys, GuideSpec()).astype(np.float64)
    truth = RADIANCE * irradiance(place.astype(np.float64), 60)[:, None]
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - truth) / np.maximum(error, 1e-3 * truth.max())).max() < 4.5
    assert not point_light(scene, lights, place, -normal, [KEY], GuideSpec()).any()
    assert not point_light(scene, lights, place, normal, [KEY], GuideSpec(light_samples=0)).any()
    assert not point_light(scene, None, place, normal, [KEY], GuideSpec()).any()


def test_under_an_even_sky_a_floor_reflects_its_albedo_and_points_receive_pi() -> None:
    scene = scene_of(floor=square((0, 0, 0), UP, 50, bsdf=diffuse()), sky={"type": "constant", "radiance": 2.0})
    found = known(scene, View(np.array([0, 3, 0.1], np.float32), np.zeros(3, np.float32)), light_samples=16)
    assert found.direct.mean(axis=(0, 1)) == pytest.approx(2 * GREY, rel=0.01)
    points = np.zeros((200, 3), np.float32), np.tile(np.array([[0, 1, 0]], np.float32), (200, 1))
    assert point_light(scene, read_lights(scene), *points, [KEY], GuideSpec()).mean() == pytest.approx(
        2 * np.pi, rel=0.03
    )


MATERIALS: dict[str, Shape] = {
    "diffuse": diffuse(),
    "roughplastic": {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": rgb(GREY)},
    "roughconductor": {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": rgb(GREY)},
    "principled": {"type": "principled", "base_color": rgb(GREY), "roughness": 0.5, "metallic": 0.3, "specular": 0.5},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_over_many_views_direct_light_gloss_and_emission_have_the_mean_of_mitsubas_path_tracer(
    name: str,
) -> None:
    """Mitsuba's paths have two edges, along the same rays of each grid; 64 views of 64 pixels, in blocks of 4."""
    floor = square((0, 0, 0), UP, 3, bsdf=MATERIALS[name])
    other = lamp((-1.2, 0.8, 0.5), (0, 0, -1), 0.3, np.array([1.0, 4.0, 2.0]))
    scene = scene_of(floor=floor, lamp=lamp(LAMP[0], DOWN, LAMP[1]), other=other)
    ours = list(of_keys(scene, ABOVE, some_keys(64, name), 2, width=8, height=8))
    images = np.stack([each.emission + each.direct + each.gloss for each in ours]).astype(np.float64)
    test = block_z_test(images, paths_of_two_edges(scene, ABOVE, spec(8, 8), 24, 8), blocks=4, significance=1e-4)
    assert test.passed, f"largest block |z| {test.z_max:.2f} (limit {test.z_limit:.2f})\n{np.round(test.z, 1)}"
    assert test.mean_ratio == pytest.approx(1, abs=5 * test.mean_ratio_standard_error + 1e-4)
    if name != "diffuse":
        assert np.abs([each.gloss for each in ours]).mean() > 0.01 * images.mean()


def paths_of_two_edges(scene: Any, view: View, of: SceneSpec, renders: int, spp: int) -> Images:
    """Independent images along the grids' rays, `spp` paths each, (K, H, W, 3)."""
    eye, rays = grid_rays(view, of)
    flat = np.tile(np.repeat(rays.reshape(-1, 3), spp, axis=0), (renders, 1)).astype(np.float32)
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*eye.tolist()), mi.Vector3f(np.ascontiguousarray(flat.T))))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(flat))
    radiance = np.array(mi.load_dict({"type": "path", "max_depth": 2}).sample(scene, sampler, ray)[0], np.float64).T
    return radiance.reshape(renders, *rays.shape[:2], -1, 3).mean(axis=3)


def test_direct_light_seen_in_a_mirror_is_that_of_the_wall_behind_times_the_reflectance() -> None:
    """A mirrored camera sees the same wall and lamp through where the mirror is."""
    wall, light = square((0, 0, 4), (0, 0, -1), 6, bsdf=diffuse()), lamp((0, 2, 1), DOWN, 0.5)
    mirror = square((0, 0, 0), (0, 0, 1), 3, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)})
    view = View(np.array([0, 0.3, 3], np.float32), np.array([0, 0.3, 0], np.float32))
    straight = View(view.origin * np.array([1, 1, -1], np.float32), np.array([0, 0.3, 0], np.float32))

    def mean(scene: Any, view: View) -> NDArray[np.float64]:
        return np.mean([each.direct for each in of_keys(scene, view, some_keys(16), 3)], axis=0)

    in_mirror = mean(scene_of(wall=wall, lamp=light, mirror=mirror), view)
    directly = mean(scene_of(wall=wall, lamp=light), straight)
    np.testing.assert_allclose(in_mirror, GREY * directly[:, ::-1], rtol=0.03, atol=1e-3 * directly.max())
    assert directly.mean() > 0.005
