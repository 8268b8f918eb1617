"""Where points stand: in rooms whose walls are made and oriented in every way."""

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import NONE, surroundings
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec_loading import load_spec


def box(low: list[float], high: list[float], *, inwards: bool = False) -> dict[str, Any]:
    """A closed box of six faces, whose normals point outwards or inwards."""
    low_, high_ = np.array(low), np.array(high)
    place = mi.ScalarTransform4f().translate(list((low_ + high_) / 2)).scale(list((high_ - low_) / 2))
    return {"type": "cube", "to_world": place, "flip_normals": inwards}


def scene_of(**shapes: dict[str, Any]) -> Any:
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def numbered(scene: Any, name: str) -> int:
    return [shape.id() for shape in scene.shapes()].index(name)


IN_ROOM, IN_BLOCK, OUTSIDE = ([[-1.5, 1.0, -1.5], [1.2, 2.5, 0.7]], [[0.5, 0.5, 0.5]], [[3.0, 1.0, 0.0]])
PLACES = np.array(IN_ROOM + IN_BLOCK + OUTSIDE, np.float32)


@pytest.mark.parametrize("walls_inwards", [False, True])
@pytest.mark.parametrize("block_inwards", [False, True])
def test_normals_do_not_matter(walls_inwards: bool, block_inwards: bool) -> None:
    scene = scene_of(
        walls=box([-2, 0, -2], [2, 3, 2], inwards=walls_inwards),
        block=box([0, 0, 0], [1, 1, 1], inwards=block_inwards),
        vase=box([-1, 0, 1], [-0.8, 0.5, 1.2]),
    )
    found = surroundings(scene, PLACES)
    np.testing.assert_array_equal(found.solid, [NONE, NONE, numbered(scene, "block"), NONE])
    np.testing.assert_array_equal(found.open, [True, True, False, False])
    assert found.leaving[0] == 0
    assert found.leaving[3] > 0.5


def test_a_wall_of_two_sides_is_a_solid_and_the_room_between_walls_is_open() -> None:
    walls = {
        "floor": box([-2.2, -0.2, -2.2], [2.2, 0, 2.2]),
        "ceiling": box([-2.2, 3, -2.2], [2.2, 3.2, 2.2]),
        "left": box([-2.2, 0, -2.2], [-2, 3, 2.2]),
        "right": box([2, 0, -2.2], [2.2, 3, 2.2]),
        "back": box([-2, 0, -2.2], [2, 3, -2]),
    }  # and no front
    scene = scene_of(**walls)
    found = surroundings(scene, np.array([[0, 1.5, 0], [-2.1, 1.5, 0], [0, 1.5, 4]], np.float32))
    np.testing.assert_array_equal(found.solid, [NONE, numbered(scene, "left"), NONE])
    np.testing.assert_array_equal(found.open, [True, False, False])


def test_a_solid_on_the_floor_holds_the_points_just_above_the_floor() -> None:
    """Its bottom and the floor are one plane, in which a ray of the whole scene meets one of them."""
    block = [-0.4, 0, -0.4], [0.4, 0.8, 0.4]
    scene = scene_of(walls=box([-2, 0, -2], [2, 3, 2]), block=box(*block), vase=box([-1, 0, 1], [-0.8, 0.5, 1.2]))
    low = np.random.default_rng(0).uniform([-0.39, 0.002, -0.39], [0.39, 0.05, 0.39], (256, 3)).astype(np.float32)
    assert (surroundings(scene, low).solid == numbered(scene, "block")).all()
    assert [shape.id() for shape in scene.shapes()] == ["walls", "block", "vase"]


def test_a_single_sheet_holds_no_point() -> None:
    sheet = mi.ScalarTransform4f().translate([0, 1, 0]).scale(0.9)
    scene = scene_of(walls=box([-2, 0, -2], [2, 3, 2]), curtain={"type": "rectangle", "to_world": sheet})
    near = np.array([[0, 1, 0.001], [0, 1, -0.001], [0.5, 1.5, 0.3]], np.float32)
    found = surroundings(scene, near)
    assert found.open.all()
    np.testing.assert_allclose(found.clearance[:2], 0.001, rtol=0.1)


def test_the_built_in_room_is_open_but_in_its_furniture() -> None:
    room = LoadedScene.load(load_spec("room")).scene
    stands = {"pedestal-stone": [-2.1, 0.3, -1.35], "sofa-fabric": [1.85, 0.25, 0.3]}
    free = [[0.3, 1.5, 0.9], [-1.9, 1.1, 1.6]]
    found = surroundings(room, np.array([*stands.values(), *free, [0, 1, 9]], np.float32))
    ids = [shape.id() for shape in room.shapes()]
    assert [ids[number] for number in found.solid[:2]] == list(stands)
    np.testing.assert_array_equal(found.open, [False, False, True, True, False])


def cube(name: str, x: float, y: float, z: float, half: tuple[float, float, float]) -> str:
    place = f'<scale x="{half[0]}" y="{half[1]}" z="{half[2]}"/><translate x="{x}" y="{y}" z="{z}"/>'
    return f'<shape type="cube" id="{name}"><transform name="to_world">{place}</transform></shape>'


HOUSE = cube("House", 0, 1.5, 0, (3, 1.5, 2))


@pytest.mark.parametrize(
    ("content", "place", "inside"),
    [
        (HOUSE + cube("Tree", 10, 1, 0, (0.3, 2, 0.3)), (-1, 1.5, 0), None),
        (
            cube("House", 0, 1.5, 0, (5, 1.6, 5)) + cube("Cupboard", -4.4, 1, -4.4, (0.59, 1, 0.59)),
            (-4.4, 1, -4.4),
            "Cupboard",
        ),
    ],
)
@pytest.mark.parametrize("there", [5, 3, 0])
def test_a_room_is_no_solid_and_a_solid_no_room_whatever_groups_are_away(
    file_scene, tmp_path, content: str, place: tuple[float, float, float], inside: str | None, there: int
) -> None:
    """Parked groups are outside of the house, or in the cupboard's box."""
    crates = [f"C{i}" for i in range(5)]
    content += "".join(cube(crate, 1 + 0.3 * i, 0.2, -0.5, (0.1, 0.2, 0.1)) for i, crate in enumerate(crates))
    zero = {"min": [0, 0, 0], "max": [0, 0, 0]}
    objects = [{"name": crate.lower(), "shapes": [crate], "at": [0, 0, 0], "box": zero} for crate in crates]
    scene = file_scene(tmp_path, content + '<emitter type="constant"/>', objects=objects)
    at_rest = rest(scene.spec)
    scene.apply(Modification(at_rest.translation, (np.arange(5) < there).astype(at_rest.present.dtype)))
    (number,) = scene.surroundings(np.array([place], np.float32)).solid
    assert (None if number == NONE else scene.scene.shapes()[number].id()) == inside
