"""Views and camera paths in a spec that says where cameras may stand."""

from typing import Any

import numpy as np
import pytest
import store_samples as samples
from scipy import stats

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import make_key
from photonfarm.scene.camera_path import CameraPath, check_clear, orbit
from photonfarm.scene.free_space import FreeSpace, pack
from photonfarm.scene.groups import Turn
from photonfarm.scene.modification import (
    Modification,
    rest,
)
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.scene.view import are_in_free_space, sample_view, sample_views

BOX = {"min": [0.0, 0.0, 0.0], "max": [4.0, 1.0, 2.0]}
FREE = np.ones((8, 2, 4), np.bool_)
FREE[:3, :, 2:] = False  # a solid of 1.5 × 1 × 1 in a corner
LONG = ((-0.9, -0.1, -0.2), (0.9, 2.0, 0.2))  # likewise
TAKES = ((-0.5, -0.1, -0.5), (0.5, 2.0, 0.5))  # around the `at` of the only group


def with_space(free: np.ndarray = FREE, **view: Any) -> SceneSpec:
    spec = samples.small_spec(
        view={"origin": BOX, "look_at": BOX},
        objects=[
            {
                "name": "object",
                "shapes": ["tall-block"],
                "at": [0, 0, 0],
                "removal_probability": 0.3,
                "box": {"min": [0, 0, 0], "max": [4, 0, 2]},
            }
        ],
    )
    shape = free.shape
    space = FreeSpace(of=spec.free_space_digest, cells=shape, free=pack(free), groups={"object": TAKES})
    return spec.model_copy(update={"view": spec.view.model_copy(update={"free_space": space, **view})})


def origins(spec: SceneSpec, modification: Modification, count: int) -> np.ndarray:
    return np.stack([sample_view(spec, make_key("m"), 0, i, modification).origin for i in range(count)])


def stands_in_the_open(points: np.ndarray, block: np.ndarray | None) -> np.ndarray:
    """Whether it does, by hand: outside of the solid, and of the room that the object takes at `block`."""
    solid = (points[:, 0] < 1.5) & (points[:, 2] > 1)
    if block is None:
        return ~solid
    low, high = np.array(TAKES) + block
    return ~solid & ~((points >= low) & (points <= high)).all(axis=1)


def test_cameras_are_uniform_in_what_is_free_of_their_configuration() -> None:
    spec = with_space()
    block = np.array([2.5, 0, 0.8], np.float32)
    found = origins(spec, Modification(block[None], np.ones(1, np.bool_)), 4000)
    assert stands_in_the_open(found, block).all()
    everywhere = np.random.default_rng(0).random((100_000, 3)) * [4, 1, 2]
    free = everywhere[stands_in_the_open(everywhere, block)]
    bins = [np.linspace(0, 4, 9), np.linspace(0, 2, 5)]
    seen, expected = (np.histogram2d(points[:, 0], points[:, 2], bins)[0].ravel() for points in (found, free))
    there = expected > 0
    assert stats.chisquare(seen[there], expected[there] * len(found) / len(free)).pvalue > 1e-4
    gone = origins(spec, Modification(np.zeros((1, 3), np.float32), np.zeros(1, np.bool_)), 1000)
    assert not stands_in_the_open(gone, block).all(), "where the object is not, a camera may stand in its place"
    assert stands_in_the_open(gone, None).all()


def test_the_box_around_a_group_turns_with_it() -> None:
    """By a quarter of a turn, long across the room: no camera stands in it, but where it would be at rest."""
    spec = with_space(np.ones_like(FREE))
    turning = spec.objects[0].model_copy(update={"turn": Turn(min=-90, max=90)})
    space = spec.view.free_space
    assert space is not None
    view = spec.view.model_copy(update={"free_space": space.model_copy(update={"groups": {"object": LONG}})})
    spec = spec.model_copy(update={"objects": (turning,), "view": view})
    standing = np.float32([[2, 0, 1, 1, 90, 1, 1, 1, 1]])
    x, y, z = (origins(spec, Modification.from_vector(standing), 2000) - [2, 0, 1]).T
    turned, at_rest = (abs(x) < 0.2) & (abs(z) < 0.9), (abs(z) < 0.2) & (abs(x) < 0.9)
    assert not turned.any()
    assert (at_rest & (y < 1)).any()


def with_all_free(spec: SceneSpec) -> SceneSpec:
    """The same scene where cameras may stand everywhere; its id is another one, and keys are given."""
    return spec.model_copy(update={"view": spec.view.model_copy(update={"free_space": None})})


def test_a_spec_without_free_space_has_the_id_and_the_views_that_it_always_had() -> None:
    spec = samples.small_spec()
    assert "free_space" not in spec.model_dump(mode="json")["view"]
    assert spec.scene_id == "7e8be82f811b27af4dc230e78efe5d71"
    assert (
        sample_view(spec, make_key("m"), 3, 4).vector.tobytes().hex()
        == "bf760b3f7116b43e37f4fc3ec4ab493fa3ae233e6c30383f"
    )
    assert with_space().scene_id != with_all_free(with_space()).scene_id


def test_free_space_of_another_scene_is_refused() -> None:
    described = with_space().model_dump(mode="json")
    assert parse_spec(described, where="test").view.free_space is not None
    for changed in (
        {"view": {**described["view"], "origin": {"min": [0, 0, 0], "max": [5, 1, 2]}}},
        {"objects": [{**described["objects"][0], "at": [1, 0, 0]}]},
        {"scene": {"builtin": "room"}, "objects": []},
    ):
        with pytest.raises(SpecError, match="measured for other"):
            parse_spec({**described, **changed}, where="test")
    moved = {**described["objects"][0], "box": {"min": [1, 0, 1], "max": [2, 0, 1]}, "removal_probability": 0.5}
    assert parse_spec({**described, "objects": [moved]}, where="test"), "where it may stand is no matter of measuring"


@pytest.mark.parametrize(
    "changed",
    [
        {"free": "no base64!"},
        {"free": "aGVsbG8="},
        {"cells": [8, 2, 5]},
        {"cells": [8, 2, 900]},
        {"free": pack(np.zeros((8, 2, 4), np.bool_))},
    ],
    ids=str,
)
def test_cells_that_cannot_be_read_are_refused(changed: dict[str, Any]) -> None:
    described = with_space().model_dump(mode="json")
    described["view"]["free_space"] |= changed
    with pytest.raises(SpecError):
        parse_spec(described, where="test")


def test_a_configuration_without_any_place_for_a_camera_is_refused_and_does_not_draw_for_ever() -> None:
    spec, key = filled(with_space()), make_key("m")
    with pytest.raises(SpecError):
        sample_view(spec, key, 0, 0)
    with pytest.raises(SpecError):
        sample_views(spec, [key], 0, [0], rest(spec).vector[None])
    gone = Modification(np.zeros((1, 3), np.float32), np.zeros(1, np.bool_))
    assert are_in_free_space(spec, sample_view(spec, key, 0, 0, gone).origin[None], gone.vector[None])[0]


def filled(spec: SceneSpec) -> SceneSpec:
    """The spec with an object that takes all of the box of origins, where it is there."""
    space = spec.view.free_space.model_copy(update={"groups": {"object": ((-9, -9, -9), (9, 9, 9))}})
    return spec.model_copy(update={"view": spec.view.model_copy(update={"free_space": space})})


def test_an_orbit_goes_around_what_stands_there_and_a_path_through_it_is_refused() -> None:
    spec = with_space()
    gone = Modification(np.zeros((1, 3), np.float32), np.zeros(1, np.bool_))
    views = orbit(spec, 24, gone)
    assert are_in_free_space(spec, np.stack([view.origin for view in views]), gone.vector[None].repeat(24, 0)).all()
    assert len({view.origin.tobytes() for view in views}) == 24
    whole = np.stack([view.origin for view in orbit(with_all_free(spec), 24, gone)])
    assert not stands_in_the_open(whole, None).all(), "or this test asks nothing"
    with pytest.raises(SpecError):
        orbit(filled(spec), 24, rest(spec))

    through = {
        "frames": 5,
        "views": [{"origin": [3, 0.5, 0.5], "look_at": [0, 0, 0]}, {"origin": [0.5, 0.5, 1.5], "look_at": [4, 0, 0]}],
    }
    path = CameraPath.model_validate(through).sample()
    with pytest.raises(SpecError, match=r"frame 3.*solid"):
        check_clear(spec, path, gone)
    beside = Modification(np.array([[3, 0, 0.5]], np.float32), np.ones(1, np.bool_))
    with pytest.raises(SpecError, match=r"frame 0.*'object'"):
        check_clear(spec, path, beside)
    assert check_clear(with_all_free(spec), path, beside) == path
