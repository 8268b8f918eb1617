from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.core.records import NOTHING, ViewBuffers
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.gbuffer import view_buffers
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.arrangement import Arrangement
from photonfarm.scene.groups import names_of_ids
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import Camera, View

COLOUR = (0.2, 0.4, 0.6)
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(COLOUR)}}
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.1, 0.1]}}
AHEAD = View(np.array([0, 0, 3], np.float32), np.array([0, 0, 0], np.float32))
BEHIND = View(np.array([0, 0, -3], np.float32), np.array([0, 0, 0], np.float32))


def spec(near: float = 0.01, far: float = 100) -> SceneSpec:
    point = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    return parse_spec(
        {
            "name": "buffers",
            "scene": {"builtin": "cornell"},
            "view": {"origin": point, "look_at": point, "fov_deg": 60, "near": near, "far": far},
            "film": {"width": 24, "height": 16},
        },
        where="test",
    )


def of(bsdf: dict[str, Any], view: View = AHEAD, shape: str = "rectangle", **limits: float) -> ViewBuffers:
    """A shape at the origin, ±1 across, facing +z."""
    mi = backend.load(1)
    scene = mi.load_dict({"type": "scene", "shape": {"type": shape, "bsdf": bsdf}}, optimize=False)
    return view_buffers(scene, [view], spec(**limits))[0]


def centre(image: np.ndarray) -> np.ndarray:
    return image[8, 12]


@pytest.mark.parametrize(
    ("bsdf", "albedo"),
    [
        (DIFFUSE, COLOUR),
        ({"type": "roughplastic", "diffuse_reflectance": DIFFUSE["reflectance"]}, COLOUR),
        ({"type": "plastic", "diffuse_reflectance": DIFFUSE["reflectance"]}, COLOUR),
        ({"type": "twosided", "bsdf": DIFFUSE}, COLOUR),
        ({"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.1}}, (0, 0, 0)),
        ({"type": "mask", "opacity": 0.5, "bsdf": DIFFUSE}, COLOUR),
        ({"type": "principled", "base_color": DIFFUSE["reflectance"], "metallic": 0.5}, COLOUR),
        ({"type": "bumpmap", "texture": {"type": "checkerboard"}, "bsdf": DIFFUSE}, COLOUR),
        ({"type": "dielectric"}, (0, 0, 0)),
        ({"type": "roughdielectric"}, (0, 0, 0)),
        ({"type": "thindielectric"}, (0, 0, 0)),
        ({"type": "conductor"}, (0, 0, 0)),
        ({"type": "roughconductor", "alpha": 0.05}, (0, 0, 0)),
        ({"type": "null"}, (0, 0, 0)),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_albedo_is_the_diffuse_reflectance(bsdf: dict[str, Any], albedo: tuple[float, ...]) -> None:
    buffers = of(bsdf)
    np.testing.assert_allclose(centre(buffers.albedo), albedo, atol=1e-6)
    assert centre(buffers.depth) == pytest.approx(3, abs=1e-5)


def test_albedo_is_the_mean_over_the_pixel_and_depth_that_of_its_centre() -> None:
    """The rectangle ends 12 / tan 30° / 3.1 = 6.705 pixels from the middle: 3 of 4 rays along an axis meet it there."""
    buffers = of(DIFFUSE, View(np.array([0, 0, 3.1], np.float32), np.array([0, 0, 0], np.float32)))
    for column in (5, 18):
        np.testing.assert_allclose(buffers.albedo[8, column], 0.75 * np.array(COLOUR), atol=1e-6)
        assert buffers.depth[8, column] == pytest.approx(3.1, abs=1e-5)
    np.testing.assert_allclose(buffers.albedo[1, 5], 0.75**2 * np.array(COLOUR), atol=1e-6)
    assert not buffers.albedo[8, 4].any()


def test_the_numbers_of_groups_go_with_what_moves_and_are_those_of_the_spec(
    small: Callable[..., SceneSpec], somewhere: View
) -> None:
    """What a number shows lies in the box of that group's shapes, wherever a configuration has put it."""
    room = LoadedScene.load(small(load_spec("room"), 48, 32))
    names = names_of_ids(room.spec.groups)
    seen = {}
    for label, change in {
        "rest": {},
        "moved": {"move": {"sofa": (-0.4, 0, 0.3)}},
        "without": {"without": ["sofa"]},
    }.items():
        standing = Arrangement.of(**change).apply(room.spec)
        room.apply(standing)
        (seen[label],) = room.find_groups([somewhere])
        depth, rays = room.buffers(somewhere).depth, Camera.of(somewhere, room.spec).rays()
        met = somewhere.origin + rays * (depth / (rays @ Camera.of(somewhere, room.spec).forward))[..., None]
        np.testing.assert_array_equal(seen[label] == NOTHING, depth == 0)
        for number in range(1, len(names)):
            of_group = [room._group_of.get(shape.id()) == number - 1 for shape in room.scene.shapes()]
            low, high = room.boxes[of_group, 0].min(axis=0) - 1e-3, room.boxes[of_group, 1].max(axis=0) + 1e-3
            shown = met[seen[label] == number] - standing.translation[number - 1]
            assert ((low <= shown) & (shown <= high)).all(), names[number]
    sofa = names.index("sofa")
    assert sofa in seen["rest"]
    assert (seen["rest"] == sofa).sum() > 20 < (seen["moved"] == sofa).sum()
    assert ((seen["rest"] == sofa) != (seen["moved"] == sofa)).any()
    assert sofa not in seen["without"]
    assert 0 in seen["rest"]


def test_a_view_that_meets_nothing_shows_no_group(small: Callable[..., SceneSpec]) -> None:
    room = LoadedScene.load(small(load_spec("room")))
    outside = View(np.array([0, 50, 0], np.float32), np.array([1, 90, 0], np.float32))
    assert (room.find_groups([outside]) == NOTHING).all()


def test_images_lie_in_memory_of_numpy_which_any_thread_may_free() -> None:
    buffers = of(DIFFUSE)
    for image in (buffers.depth, buffers.albedo, buffers.normal):
        owner = image
        while owner.base is not None:
            assert isinstance(owner.base, np.ndarray), "memory of Dr.Jit"
            owner = owner.base


@pytest.mark.parametrize(
    ("bsdf", "front", "back"),
    [
        (DIFFUSE, COLOUR, (0, 0, 0)),
        ({"type": "plastic"}, (0.5, 0.5, 0.5), (0, 0, 0)),
        ({"type": "twosided", "front": DIFFUSE, "back": RED}, COLOUR, (0.9, 0.1, 0.1)),
        # what Mitsuba flags as two-sided keeps its front's albedo from behind
        ({"type": "principled", "base_color": DIFFUSE["reflectance"]}, COLOUR, COLOUR),
        ({"type": "mask", "opacity": 0.5, "bsdf": DIFFUSE}, COLOUR, COLOUR),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_a_surface_shows_the_albedo_of_the_side_that_is_seen_and_the_normal_as_modelled(
    bsdf: dict[str, Any], front: tuple[float, ...], back: tuple[float, ...]
) -> None:
    for albedo, buffers in ((front, of(bsdf)), (back, of(bsdf, BEHIND))):
        np.testing.assert_allclose(centre(buffers.albedo), albedo, atol=1e-6)
        np.testing.assert_array_equal(centre(buffers.normal), (0, 0, 1))
        assert centre(buffers.depth) == pytest.approx(3, abs=1e-5)


def test_a_ray_that_hits_nothing_gives_zeros() -> None:
    buffers = of(DIFFUSE, View(np.array([0, 0, 3], np.float32), np.array([0, 0, 9], np.float32)))
    for image in (buffers.depth, buffers.albedo, buffers.normal):
        assert not image.any()


@pytest.mark.parametrize("limits", [{"near": 3.5}, {"far": 2.5}])
def test_what_lies_outside_the_clip_planes_is_not_seen(limits: dict[str, float]) -> None:
    assert not of(DIFFUSE, **limits).depth.any()


def test_depth_is_along_the_axis_and_leads_back_to_the_surface() -> None:
    """A plane across the axis has one depth; on a sphere, origin + ray · depth / (ray · forward) has radius 1."""
    flat = of(DIFFUSE).depth
    np.testing.assert_allclose(flat[flat > 0], 3, atol=1e-5)
    view = View(np.array([1.5, 1.2, 2.0], np.float32), np.array([0.1, 0, 0], np.float32))
    ball = of(DIFFUSE, view, "sphere")
    camera = Camera.of(view, spec())
    rays = camera.rays().astype(np.float64)
    hit = camera.origin + rays * (ball.depth / (rays @ camera.forward))[..., None]
    seen = ball.depth > 0
    assert 0.1 < seen.mean() < 0.9
    np.testing.assert_allclose(np.linalg.norm(hit[seen], axis=-1), 1, atol=1e-4)
    np.testing.assert_allclose(ball.normal[seen], hit[seen], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(ball.normal[seen], axis=-1), 1, atol=1e-3)
