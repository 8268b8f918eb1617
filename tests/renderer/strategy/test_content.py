from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

from photonfarm.renderer.strategy.candidates import GRID, PLAIN  # noqa: E402
from photonfarm.renderer.strategy.content import LightReach, SceneContent, light_reach, recommend_photons  # noqa: E402
from photonfarm.scene.groups import Box  # noqa: E402
from photonfarm.scene.spec import PhotonSpec, ViewSpec  # noqa: E402
from tests.stability.scenes.hard_scenes import HARD_SCENES  # noqa: E402 - after the variant is set

MIRROR = {"type": "sphere", "bsdf": {"type": "conductor"}}
BULB = {"type": "point", "intensity": {"type": "rgb", "value": 1.0}}


def read(description: dict[str, Any]) -> SceneContent:
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, **description}, optimize=False)
    return SceneContent.of(scene, scene.sensors()[0])


def test_the_lights_of_a_scene_are_counted_by_kind_and_those_that_do_not_shine_apart() -> None:
    scene = mi.load_dict(HARD_SCENES["many_lights"](16), optimize=False)
    found = SceneContent.of(scene, scene.sensors()[0])
    others = dict.fromkeys(("PointLight", "SpotLight", "DirectionalEmitter", "ConstantBackgroundEmitter"), 1)
    assert found.lights == {"AreaLight": 4, **others}
    assert (found.dark, found.specular, found.camera) == (0, 0, "PerspectiveCamera")
    dark = {"type": "point", "intensity": {"type": "rgb", "value": 0.0}}
    off = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32)), "scale": 0.0}
    assert read({"ball": MIRROR, "a": BULB, "b": dark, "sky": off}).dark == 2


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
    assert reason in str(read(description).why_no_light_paths(max_depth, hit_share))


def test_from_three_edges_on_light_paths_and_connections_have_a_place() -> None:
    found = read({"ball": {"type": "sphere"}, "bulb": BULB})
    assert found.why_no_light_paths(3, 1.0) is None
    assert found.why_no_light_paths(-1, 1.0) is None


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
    reach = light_reach([scene, scene], AROUND, seed=1)
    assert (reach.configurations, reach.hit, reach.near) == (2, 1, 1)
    power = 0.5 ** np.arange(16)
    np.testing.assert_allclose(reach.beyond, 1 - np.cumsum(power) / power.sum(), atol=1e-5)


def test_hits_far_from_the_cameras_do_not_count() -> None:
    far = {"type": "sphere", "center": [50, 0, 0], "radius": 40, "flip_normals": True}
    scene = mi.load_dict({"type": "scene", "sphere": far, "bulb": {**BULB, "position": [50, 0, 0]}}, optimize=False)
    reach = light_reach([scene], AROUND, seed=1)
    assert (reach.hit, reach.near, max(reach.beyond)) == (1, 0, 0)
    photons, reason = recommend_photons(PhotonSpec(), reach, max_depth=8)
    assert photons.paths == 0
    assert "0.0% of the light paths, at most, reach" in reason
    assert "raise it by hand" in reason


@pytest.mark.parametrize(
    ("wanted", "beyond", "max_depth", "depth"),
    [
        (4, (0.4, 0.1, 0.0, 0.0), 8, 3),  # nothing beyond the third
        (4, (0.1, 0.005, 0.001, 0.0), 8, 2),  # half a per cent
        (2, (0.6, 0.3, 0.1, 0.0), 8, 2),  # never more than the spec wants
        (4, (0.6, 0.3, 0.1, 0.0), 3, 2),  # a third hit lies on paths of four edges
        (4, (0.6, 0.3, 0.1, 0.0), -1, 4),
    ],
)
def test_bounces_that_carry_next_to_nothing_are_not_stored(
    wanted: int, beyond: tuple[float, ...], max_depth: int, depth: int
) -> None:
    reach = LightReach(configurations=16, hit=1.0, near=0.9, beyond=beyond)
    photons, sentence = recommend_photons(PhotonSpec(paths=64, depth=wanted), reach, max_depth)
    assert photons == PhotonSpec(paths=64, depth=depth)
    assert ("raise it by hand" in sentence) == (depth < wanted)
    assert "16 draws of the configuration" in sentence


def test_the_configuration_that_most_light_reaches_counts() -> None:
    """A closed sphere in which light is reflected, beside one of which the light is far away."""
    sphere = {"type": "sphere", "radius": 0.5, "flip_normals": True}
    near, far = (
        mi.load_dict({"type": "scene", "sphere": sphere, "bulb": {**BULB, "position": [x, 0, 0]}}, optimize=False)
        for x in (0, 50)
    )
    assert light_reach([far, near], AROUND, seed=1).near == light_reach([near], AROUND, seed=2).near > 0.9


def test_no_photons_stay_no_photons() -> None:
    reach = LightReach(configurations=1, hit=1.0, near=1.0, beyond=(0.0,))
    assert recommend_photons(PhotonSpec(paths=0), reach, 8)[0].paths == 0
    assert recommend_photons(PhotonSpec(), reach, 1)[0].paths == 0
