from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

from photonfarm.renderer.strategy import content  # noqa: E402
from photonfarm.renderer.strategy.candidates import GRID, PLAIN  # noqa: E402
from photonfarm.scene.spec import Box, PhotonSpec, ViewSpec  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES  # noqa: E402 - after the variant is set

MIRROR = {"type": "sphere", "bsdf": {"type": "conductor"}}
BULB = {"type": "point", "intensity": {"type": "rgb", "value": 1.0}}


def read(description: dict[str, Any]) -> content.SceneContent:
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, **description}, optimize=False)
    return content.read(scene, scene.sensors()[0])


def test_the_lights_of_a_scene_are_counted_by_kind() -> None:
    scene = mi.load_dict(HARD_SCENES["many_lights"](16), optimize=False)
    found = content.read(scene, scene.sensors()[0])
    assert found.lights == {"area": 4, "point": 1, "spot": 1, "directional": 1, "constant environment": 1}
    assert (found.dark, found.specular, found.camera) == (0, 0, "pinhole")


def test_lights_that_do_not_shine_are_counted_apart_whatever_makes_them_dark() -> None:
    dark = {"type": "point", "intensity": {"type": "rgb", "value": 0.0}}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((8, 16, 3), np.float32))}
    off = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32)), "scale": 0.0}
    assert read({"ball": MIRROR, "a": BULB, "b": dark, "sky": sky}).dark == 2
    assert read({"ball": MIRROR, "a": BULB, "sky": off}).dark == 1


@pytest.mark.parametrize("kind", ["conductor", "dielectric", "thindielectric", "null"])
def test_what_only_mirrors_is_told_from_what_scatters(kind: str) -> None:
    assert read({"ball": {"type": "sphere", "bsdf": {"type": kind}}, "bulb": BULB}).specular == 1
    assert read({"ball": {"type": "sphere", "bsdf": {"type": "roughconductor"}}, "bulb": BULB}).specular == 0
    assert read({"ball": {"type": "sphere", "bsdf": {"type": "plastic"}}, "bulb": BULB}).specular == 0


@pytest.mark.parametrize(
    ("description", "max_depth", "hit_share", "reason"),
    [
        ({"ball": {"type": "sphere"}}, 8, 1.0, "there is no light that shines"),
        ({"ball": {"type": "sphere"}, "bulb": BULB}, 1, 1.0, "only lights themselves are seen"),
        ({"ball": {"type": "sphere"}, "bulb": BULB}, 2, 1.0, "connections need 3 edges"),
        ({"ball": MIRROR, "bulb": BULB}, 8, 1.0, "joined to nothing"),
        ({"ball": {"type": "sphere"}, "bulb": BULB}, 8, 0.0, "none of them hits a surface"),
        (
            {"ball": {"type": "sphere"}, "bulb": BULB, "camera": {"type": "orthographic"}},
            8,
            1.0,
            "joined to a camera of type OrthographicCamera",
        ),
    ],
)
def test_light_paths_that_could_not_help_are_left_out_with_a_reason(
    description: dict[str, Any], max_depth: int, hit_share: float, reason: str
) -> None:
    candidates, left_out = content.restrict(read(description), max_depth, hit_share, GRID)
    assert candidates == [PLAIN]
    assert reason in str(left_out[0])


def test_from_three_edges_on_light_paths_and_connections_have_a_place() -> None:
    found = read({"ball": {"type": "sphere"}, "bulb": BULB})
    assert content.restrict(found, 3, 1.0, GRID) == (list(GRID), [])
    assert content.restrict(found, -1, 1.0, GRID) == (list(GRID), [])


def test_each_kind_of_settings_is_among_the_first_that_are_compared() -> None:
    """In little time only the first are."""
    first = GRID[:5]
    assert first[0] == PLAIN
    assert any(c.guided_light and c.connections for c in first)
    assert any(c.guided_light and not c.connections for c in first)
    assert any(c.light_samples > 1 for c in first)


# ----------------------------------------------------------------------------------------------------------- photons

AROUND = ViewSpec(origin=Box(min=(-0.5, -0.5, -0.5), max=(0.5, 0.5, 0.5)), look_at=Box(min=(0, 0, 0), max=(0, 0, 0)))


def test_light_in_a_closed_sphere_loses_what_it_absorbs_at_each_bounce() -> None:
    """Albedo 0.5 keeps half of the power at each hit; a light in the middle misses nothing."""
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    sphere = {"type": "sphere", "radius": 0.5, "flip_normals": True, "bsdf": grey}
    scene = mi.load_dict({"type": "scene", "sphere": sphere, "bulb": BULB}, optimize=False)
    reach = content.light_reach([scene, scene], AROUND, seed=1)
    assert reach.hit == 1
    expected = 0.5 ** np.arange(16)
    np.testing.assert_allclose(reach.power, [expected / expected.sum()] * 2, rtol=1e-4)


def test_hits_far_from_the_cameras_do_not_count() -> None:
    far = {"type": "sphere", "center": [50, 0, 0], "radius": 40, "flip_normals": True}
    scene = mi.load_dict({"type": "scene", "sphere": far, "bulb": {**BULB, "position": [50, 0, 0]}}, optimize=False)
    reach = content.light_reach([scene], AROUND, seed=1)
    assert reach.hit == 1
    assert np.max(reach.near) == 0
    assert np.sum(reach.power) == 0
    photons, reason = content.recommend_photons(PhotonSpec(), reach.near, reach.power, max_depth=8)
    assert photons.paths == 0
    assert "0.0% of the light paths, at most, reach" in reason


@pytest.mark.parametrize(
    ("wanted", "power", "max_depth", "depth"),
    [
        (4, (0.6, 0.3, 0.1, 0.0), 8, 3),  # nothing beyond the third
        (4, (0.9, 0.095, 0.004, 0.001), 8, 2),  # half a per cent
        (2, (0.4, 0.3, 0.2, 0.1), 8, 2),  # never more than the spec wants
        (4, (0.4, 0.3, 0.2, 0.1), 3, 2),  # a third hit lies on paths of four edges
        (4, (0.4, 0.3, 0.2, 0.1), -1, 4),
    ],
)
def test_bounces_that_carry_next_to_nothing_are_not_stored(
    wanted: int, power: tuple[float, ...], max_depth: int, depth: int
) -> None:
    near = [(0.9, 0.8, 0.7, 0.6)]
    photons, sentence = content.recommend_photons(PhotonSpec(paths=64, depth=wanted), near, [power], max_depth)
    assert photons == PhotonSpec(paths=64, depth=depth)
    assert ("raise it by hand" in sentence) == (depth < wanted)


def test_photons_that_shine_in_one_configuration_are_stored_for_all() -> None:
    """The power beyond two hits is 2.4 % in one configuration of sixteen, and 0.15 % on average."""
    dull, bright = (0.9, 0.1, 0.0, 0.0), (0.8, 0.176, 0.024, 0.0)
    wanted = PhotonSpec(paths=64, depth=4)
    near = [(0.9, 0.8, 0.7, 0.6)] * 16
    assert content.recommend_photons(wanted, near, [dull] * 16, 8)[0].depth == 2
    photons, sentence = content.recommend_photons(wanted, near, [dull] * 15 + [bright], 8)
    assert photons.depth == 3
    assert "16 draws of the configuration" in sentence
    unlit = [(0.001,) * 4] * 15
    assert content.recommend_photons(wanted, [*unlit, (0.1,) * 4], [dull] * 16, 8)[0].paths == 64
    photons, sentence = content.recommend_photons(wanted, [*unlit, (0.001,) * 4], [dull] * 16, 8)
    assert photons.paths == 0
    assert "raise it by hand" in sentence


def test_no_photons_stay_no_photons() -> None:
    assert content.recommend_photons(PhotonSpec(paths=0), [(1.0,)], [(1.0,)], 8)[0].paths == 0
    assert content.recommend_photons(PhotonSpec(), [(1.0,)], [(1.0,)], 1)[0].paths == 0
