"""Guides against formulas and against Mitsuba's path tracer."""

import gc
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.gbuffer import GRID, view_buffers
from photonfarm.shared.core.keys import make_key
from photonfarm.shared.core.records import Guides, arrays_of
from photonfarm.shared.core.statistics import block_z_test
from photonfarm.shared.scene.spec import GuideSpec, SceneSpec
from photonfarm.shared.scene.spec_loading import parse_spec
from photonfarm.shared.scene.view import Camera, View

mi = backend.load(threads=1)

from photonfarm.renderer.bdpt.recording import Recorder  # noqa: E402
from photonfarm.renderer.scene import guides  # noqa: E402 - after the variant is set
from photonfarm.renderer.scene.guides import point_light, view_guides  # noqa: E402
from photonfarm.renderer.scene.materials import Materials  # noqa: E402

Images = NDArray[np.float64]
Shape = dict[str, Any]

WIDTH, HEIGHT = 24, 16
AHEAD = View(np.array([0, 0, 3], np.float32), np.array([0, 0, 0], np.float32))
KEY = make_key("view", "of a test")
NOWHERE = np.zeros((1, 3), np.float32)
RADIANCE = np.array([5.0, 3.0, 1.0])
GREY = np.array([0.5, 0.4, 0.3])


@pytest.fixture(autouse=True, scope="module")
def no_other_materials() -> None:
    """Kernels hold the code of every material that is alive, also of other tests' that can only be looked at."""
    gc.collect()


def spec(width: int = WIDTH, height: int = HEIGHT, **changes: Any) -> SceneSpec:
    point = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    described = {
        "name": "guides",
        "scene": {"builtin": "cornell"},
        "view": {"origin": point, "look_at": point, "fov_deg": 40},
        "film": {"width": width, "height": height},
    }
    return parse_spec({**described, **changes}, where="test")


def scene_of(**shapes: Shape) -> Any:
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def known(scene: Any, view: View = AHEAD, *, light_samples: int = 3, **of_spec: Any) -> Guides:
    """The guides of a view."""
    return next(of_keys(scene, view, [KEY], light_samples, **of_spec))


def of_keys(scene: Any, view: View, keys: list[bytes], light_samples: int, **of_spec: Any) -> Iterator[Guides]:
    """The guides of a view by several keys, one after the other."""
    recorder, wanted = Recorder(guides.trace) if len(keys) > 1 else None, GuideSpec(light_samples=light_samples)
    for key in keys:
        yield view_guides(scene, view, spec(**of_spec), wanted, key, Materials.of(scene), NOWHERE, recorder)


def some_keys(count: int, of: str = "key") -> list[bytes]:
    return [make_key(of, number) for number in range(count)]


def rgb(colour: NDArray[np.float64]) -> Shape:
    return {"type": "rgb", "value": colour.tolist()}


def diffuse(colour: NDArray[np.float64] = GREY) -> Shape:
    return {"type": "diffuse", "reflectance": rgb(colour)}


BLACK = diffuse(np.zeros(3))


def square(place: tuple[float, float, float], facing: tuple[float, float, float], size: float, **more: Any) -> Shape:
    """A square of half side `size` around a point, facing a way along the z or y axis."""
    up = [0, 0, 1] if facing[1] else [0, 1, 0]
    turn = mi.ScalarTransform4f().look_at(origin=list(place), target=np.add(place, facing).tolist(), up=up)
    return {"type": "rectangle", "to_world": turn @ mi.ScalarTransform4f().scale(size), **more}


def lamp(
    place: tuple[float, float, float], facing: tuple[float, float, float], size: float, radiance: Images = RADIANCE
) -> Shape:
    return square(place, facing, size, bsdf=BLACK, emitter={"type": "area", "radiance": rgb(radiance)})


def centre(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return image[HEIGHT // 2, WIDTH // 2]


def grid_rays(view: View, of: SceneSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The eye (3,), and unit directions through the grid of each pixel, (H, W, 16, 3)."""
    camera = Camera.of(view, of)
    steps = (np.arange(GRID) + 0.5) / GRID
    return camera.origin, np.stack([camera.rays(u, v) for v in steps for u in steps], axis=2).astype(np.float64)


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
    found = np.stack([point_light(scene, place, normal, key, GuideSpec()) for key in keys]).astype(np.float64)
    truth = RADIANCE * irradiance(place.astype(np.float64), 60)[:, None]
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - truth) / np.maximum(error, 1e-3 * truth.max())).max() < 4.5
    assert not point_light(scene, place, -normal, KEY, GuideSpec()).any()
    assert not point_light(scene, place, normal, KEY, GuideSpec(light_samples=0)).any()


def test_under_an_even_sky_a_floor_reflects_its_albedo_and_points_receive_pi() -> None:
    scene = scene_of(floor=square((0, 0, 0), UP, 50, bsdf=diffuse()), sky={"type": "constant", "radiance": 2.0})
    found = known(scene, View(np.array([0, 3, 0.1], np.float32), np.zeros(3, np.float32)), light_samples=16)
    assert found.direct.mean(axis=(0, 1)) == pytest.approx(2 * GREY, rel=0.01)
    points = np.zeros((200, 3), np.float32), np.tile(np.array([[0, 1, 0]], np.float32), (200, 1))
    assert point_light(scene, *points, KEY, GuideSpec()).mean() == pytest.approx(2 * np.pi, rel=0.03)


def test_without_light_samples_or_lamps_nothing_arrives() -> None:
    dark = known(floor_and_lamp(), ABOVE, light_samples=0)
    assert not dark.direct.any()
    assert not dark.gloss.any()
    assert dark.mean_depth.any()
    assert not known(scene_of(floor=square((0, 0, 0), UP, 3, bsdf=diffuse())), ABOVE).direct.any()
    only_emission = known(floor_and_lamp(), ABOVE, transport={"max_depth": 1})
    assert not only_emission.direct.any()


MATERIALS: dict[str, Shape] = {
    "diffuse": diffuse(),
    "roughplastic": {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": rgb(GREY)},
    "roughconductor": {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": rgb(GREY)},
    "principled": {"type": "principled", "base_color": rgb(GREY), "roughness": 0.5, "metallic": 0.3, "specular": 0.5},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_over_many_views_direct_light_gloss_and_emission_have_the_mean_of_mitsubas_path_tracer(
    name: str, monkeypatch: pytest.MonkeyPatch
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


@pytest.mark.parametrize("nonlinear", [False, True])
def test_specular_of_a_rough_plastic_ball_lies_between_the_fresnel_reflectance_head_on_and_1(nonlinear: bool) -> None:
    bsdf = {"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": rgb(WHITE), "nonlinear": nonlinear}
    found, _ = of_a_ball(bsdf)
    assert 0.038 < found.min() < 0.04
    assert 0.1 < found.max() < 1


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


def test_mean_depth_and_normal_are_the_centres_on_a_plane_and_the_normal_is_turned_to_the_eye() -> None:
    scene = scene_of(wall=square((0, 0, 0), (0, 0, 1), 4, bsdf={"type": "twosided", "bsdf": diffuse()}))
    for z in (3, -3):
        view = View(np.array([0.3, 0.2, z], np.float32), np.array([0.3, 0.2, 0], np.float32))
        found, buffers = known(scene, view), view_buffers(scene, view, spec())
        np.testing.assert_allclose(found.mean_depth, buffers.depth, rtol=1e-5)
        np.testing.assert_allclose(found.mean_normal, np.sign(z) * buffers.normal, atol=1e-6)
    slanted = View(np.array([2, 1.5, 2], np.float32), np.zeros(3, np.float32))
    found, buffers = known(scene, slanted), view_buffers(scene, slanted, spec())
    whole = buffers.depth > 0
    inner = np.pad(whole, 1)[:-2, 1:-1] & np.pad(whole, 1)[2:, 1:-1] & whole
    np.testing.assert_allclose(found.mean_depth[inner], buffers.depth[inner], rtol=5e-3)


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
    behind = view_buffers(scene_of(wall=wall), virtual, spec()).albedo[:, ::-1]
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


def test_what_scatters_by_itself_has_nothing_beyond() -> None:
    texture = {"type": "diffuse", "reflectance": rgb(GREY)}
    scene = scene_of(
        wall=square((0, 0, 0), (0, 0, 1), 3, bsdf=texture),
        mirror=square((0, 0, 9), (0, 0, -1), 3, bsdf={"type": "conductor"}),
    )
    found = known(scene)
    for name in ("throughput", "beyond_albedo", "beyond_normal", "beyond_depth"):
        assert not getattr(found, name).any(), name


def test_two_mirrors_that_face_each_other_end_after_so_many(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(
        front=square((0, 0, 0), (0, 0, 1), 20, bsdf={"type": "conductor", "specular_reflectance": rgb(GREY)}),
        back=square((0, 0, 4), (0, 0, -1), 20, bsdf={"type": "conductor"}),
    )
    found = known(scene)
    np.testing.assert_allclose(centre(found.throughput), GREY ** (guides.FOLLOWED / 2), rtol=1e-4)
    assert all(np.isfinite(values).all() for values in arrays_of(found).values())
