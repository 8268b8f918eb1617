"""The proposal for a room: what stands or hangs in it, where that may go, and where cameras are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imported_scenes import proposed
from pydantic import TypeAdapter

from photonfarm.core.models import Name
from photonfarm.renderer.scene.surroundings import surroundings
from photonfarm.renderer.tools.importing.proposal.groups import group_name, is_furniture, is_shell
from photonfarm.renderer.tools.importing.proposal.proposed import largest_rectangle
from photonfarm.renderer.tools.importing.proposal.surfaces import Box, Frame

pytestmark = pytest.mark.usefixtures("few_points")

Put = Callable[..., None]


@pytest.fixture(scope="module")
def proposal(boxes: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The proposal for the room of boxes, and its Mitsuba scene."""
    return proposed(boxes, tmp_path_factory.mktemp("scratch"))


def names(found: Any) -> list[str]:
    return sorted(movable.thing.name for movable in found.movables)


def in_solids(scene: Any, box: Box) -> np.ndarray:
    """Random cameras in a box: what is around them."""
    at = np.random.default_rng(0).uniform(box.low, box.high, (200, 3))
    return surroundings(scene, Frame((0, 1, 0)).world(at).astype(np.float32))


def test_the_room_is_found_and_all_that_stands_in_it_also_two_chairs_of_one_mesh(proposal: Any) -> None:
    found, _ = proposal
    assert [found.room.low, found.room.high] == pytest.approx(np.array([[0, 0, 0], [5, 4, 2.6]]), abs=0.01)
    assert found.room.has_ceiling
    assert names(found) == ["Chairs", "Chairs-2", "Table", "Wardrobe"]
    for number, movable in enumerate(found.movables):
        assert (found.thing == number).sum() == 12
        half = movable.thing.size[:2] / 2
        assert (movable.box.low[:2] - half >= found.room.low[:2] - 1e-6).all()
        assert (movable.box.high[:2] + half <= found.room.high[:2] + 1e-6).all()
        assert movable.box.low[2] == movable.box.high[2] == movable.thing.at[2] == pytest.approx(0, abs=1e-6)
        assert (movable.box.high[:2] > movable.box.low[:2]).all()


def test_cameras_stand_in_the_open_below_the_light_to_add_and_look_at_what_stands_there(proposal: Any) -> None:
    found, scene = proposal
    origin, look_at = found.views[0]
    assert in_solids(scene, origin).open.all()
    middles = np.array([(movable.thing.low + movable.thing.high) / 2 for movable in found.movables])
    assert (look_at.high > look_at.low).all()
    assert ((look_at.low < middles.mean(axis=0)) & (middles.mean(axis=0) < look_at.high))[:2].all()
    assert look_at.high[2] < origin.low[2]
    light = found.light
    assert 2.5 < light.box.low[2] == light.box.high[2] < 2.6
    assert (light.box.low[:2] - light.size / 2 > 0).all()
    assert (light.box.high[:2] + light.size / 2 < [5, 4]).all()


ROOM = {"Shell": ((0, 0, 0), (5, 2.6, 4), "in"), "Table": ((2, 0, 1.5), (3.2, 0.75, 2.2))}
HOUSE = {"Inner": ((-3.1, 0, -1.8), (3.1, 2.5, 1.8), "in"), "Outer": ((-3.2, -0.02, -1.9), (3.2, 2.6, 1.9))}
ROOMS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "a box in another one is a thing of its own, and a sheet is none": (
        {
            "Shell": ROOM["Shell"],
            "Stool": ((3, 0, 2), (3.6, 0.6, 2.6)),
            "Basket": ((3.1, 0, 2.1), (3.5, 0.5, 2.5)),
            "Sheet": ((1, 0, 1), (1.01, 0.8, 1.6)),
        },
        ["Basket", "Stool"],
    ),
    "of closed rooms the one with something in it is shown": (
        {
            "Large": ((0, 0, 0), (4, 2.6, 4), "in"),
            "Small": ((4.2, 0, 0), (7.2, 2.6, 4), "in"),
            "Sofa": ((5, 0, 1), (6.4, 0.8, 1.9)),
        },
        ["Sofa"],
    ),
    "of rooms with furniture that with most is shown": (
        {
            "Bedroom": ((0, 0, 0), (4, 2.6, 4), "in"),
            "Bed": ((1, 0, 1), (2.8, 0.5, 2.8)),
            "Globe": ((2, 2, 2), (2.3, 2.3, 2.3), 9),
            "Living": ((4.2, 0, 0), (7.2, 2.6, 4), "in"),
            "Sofa": ((5, 0, 1), (6.4, 0.8, 1.9)),
            "Board": ((5, 0, 2.8), (6.6, 1.6, 3.3)),
        },
        ["Board", "Sofa"],
    ),
    "a furnished room on a large ground is seen from within": (
        {
            **HOUSE,
            "Lawn": ((-300, -0.06, -300), (300, -0.04, 300)),
            "Table": ((-0.5, 0, -0.5), (0.5, 0.7, 0.5)),
        },
        ["Table"],
    ),
    "an empty one is seen from outside": ({**HOUSE, "Lawn": ((-15, -0.06, -15), (15, -0.04, 15))}, []),
}


@pytest.mark.parametrize("case", ROOMS)
def test_of_a_scene_the_room_with_most_in_it_is_shown(put: Put, gltf: Any, tmp_path: Path, case: str) -> None:
    scene, expected = ROOMS[case]
    for name, (low, high, *more) in scene.items():
        put(name, low, high, inwards="in" in more, light=sum(each for each in more if each != "in"))
    found, _ = proposed(gltf.write(), tmp_path)
    assert names(found) == expected
    assert found.room.has_ceiling == bool(expected)
    assert found.has_others == ("Bedroom" in scene)
    assert found.stays == ({"outside the room": ["Globe"]} if "Globe" in scene else {})


def test_the_back_of_an_armchair_before_a_bay_is_part_of_it_and_a_picture_on_a_wall_is_not(
    put: Put, gltf: Any, tmp_path: Path
) -> None:
    for number, (low, high) in enumerate(
        [
            ((0, -0.1, -0.9), (5, 0, 4)),
            ((0, 2.6, -0.9), (5, 2.7, 4)),
            ((-0.1, 0, 0), (0, 2.6, 4)),
            ((5, 0, 0), (5.1, 2.6, 4)),
            ((0, 0, 4), (5, 2.6, 4.1)),
            ((0, 0, -0.1), (2.05, 2.6, 0)),
            ((2.95, 0, -0.1), (5, 2.6, 0)),
            ((1.95, 0, -0.9), (2.05, 2.6, -0.1)),
            ((2.95, 0, -0.9), (3.05, 2.6, -0.1)),
            ((1.95, 0, -1), (3.05, 2.6, -0.9)),
        ]
    ):
        put(f"Part_{number}", low, high)
    put("Seat", (2, 0, 0.05), (3, 0.45, 0.9))
    put("Rest", (2.1, 0.4, -0.02), (2.9, 0.9, 0.12))
    put("Picture", (4, 0, 0), (4.6, 0.7, 0.1))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.low[1] == pytest.approx(0, abs=0.05)
    (moves,) = found.movables
    assert [moves.thing.low, moves.thing.high] == pytest.approx(np.array([[2, -0.02, 0], [3, 0.9, 0.9]]), abs=1e-3)


def test_lights_and_strays_far_above_a_room_without_a_ceiling_do_not_make_it_high(
    put: Put, gltf: Any, tmp_path: Path
) -> None:
    put("Floor", (0, -0.1, 0), (5, 0, 4))
    for number, (low, high) in enumerate(
        [((-0.1, 0), (0, 4)), ((5, 0), (5.1, 4)), ((0, -0.1), (5, 0)), ((0, 4), (5, 4.1))]
    ):
        put(f"Wall{number}", (low[0], 0, low[1]), (high[0], 2.6, high[1]))
    put("Table", (2, 0, 1.5), (3.2, 0.75, 2.2))
    put("Sun", (2, 12, 2), (2.5, 12.5, 2.5), light=9)
    put("Stray", (2, 301, 2), (2.5, 301.5, 2.5))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.height < 4
    assert found.views[0].origin.high[2] < 2.6
    assert names(found) == ["Table"]


def test_a_cube_on_a_floor_is_no_room_and_cameras_look_down_on_it(put: Put, gltf: Any, tmp_path: Path) -> None:
    put("Cube", (-0.5, 0, -0.5), (0.5, 1, 0.5))
    put("Floor", (-500, 0, -500), (500, 0, 500))
    found, scene = proposed(gltf.write(), tmp_path)
    assert not found.room.has_ceiling
    assert names(found) == ["Cube"]
    origin, look_at = found.views[0]
    assert (in_solids(scene, origin).solid < 0).all()
    assert 1 < origin.low[2] < origin.high[2] < 3
    assert np.abs([*origin, *look_at])[:, :2].max() < 3


def test_what_is_close_to_a_wall_and_does_not_reach_it_is_no_part_of_it(
    room: None, put: Put, gltf: Any, tmp_path: Path
) -> None:
    put("Top", (0.05, 0.7, 1.5), (1.2, 0.75, 2.2))
    for number, x in enumerate((0.05, 1.15)):
        put(f"Leg{number}", (x, 0, 1.5), (x + 0.05, 0.7, 2.2))
    put("Panel", (0, 0.1, 3), (0.05, 1.5, 3.9))
    for node in gltf.document["nodes"]:
        node.pop("name")  # names keep objects together
    found, _ = proposed(gltf.write(), tmp_path)
    assert sorted(len(set(found.shape[found.thing == number])) for number in range(len(found.movables))) == [1, 3]


def test_a_room_of_mirrored_rectangles_is_seen_from_their_front(tmp_path: Path) -> None:
    sides = [("x", 0), ("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 270)]
    shapes = "".join(
        f'<shape type="rectangle"><transform name="to_world"><scale x="-2" y="2"/><translate z="-2"/>'
        f'<rotate {axis}="1" angle="{angle}"/></transform></shape>'
        for axis, angle in sides
    )
    table = '<shape type="cube" id="Table"><transform name="to_world"><scale value="0.5"/><translate y="-1.5"/>'
    file = tmp_path / "room.xml"
    file.write_text(f'<scene version="3.0.0">{shapes}{table}</transform></shape></scene>')
    found, _ = proposed(file, tmp_path)
    assert found.room.has_ceiling
    assert names(found) == ["Table"]


@pytest.mark.parametrize("camera", [None, (9, 1, 0)])
def test_a_house_alone_is_seen_from_outside_from_the_side_of_the_camera(
    put: Put, gltf: Any, tmp_path: Path, camera: Any
) -> None:
    put("House", (-2, 0, -2), (2, 3, 2))
    put("Lantern", (1, 3.2, 1), (1.2, 3.4, 1.2), light=5)
    if camera is not None:
        gltf.document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}]
        gltf.node("Camera", camera=0, translation=list(camera))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.is_stage
    assert [*found.stays.values()] == [["Lantern"]]
    middle = (found.views[0].origin.low + found.views[0].origin.high)[:2] / 2
    towards = np.array([0, 1]) if camera is None else np.array([camera[0], camera[2]]) / 9
    assert middle @ towards > 2.5
    assert abs(middle @ towards[::-1]) < 0.1


@pytest.mark.parametrize(
    ("low", "high", "name", "reach"),
    [
        ((2, 2.58, 1.5), (3, 2.58, 2.1), "Panel", [2.5, 2]),
        ((2, 2.5, 1.5), (3, 2.6, 2.1), "Ceiling light", [2.5, 2]),
        ((2.5, 1.8, 1.6), (2.8, 2.1, 1.9), "Globe", [2.5, 2]),
        ((0.5, 2.5, 1.95), (4.5, 2.56, 2.05), "Tube", [0.8, 2]),  # nearly as long as the room
    ],
)
def test_a_lamp_moves_along_the_ceiling_where_it_hangs(
    room: None, put: Put, gltf: Any, tmp_path: Path, low: Any, high: Any, name: str, reach: list[float]
) -> None:
    put(name, low, high, light=8)
    found, scene = proposed(gltf.write(), tmp_path)
    (lamp,) = [movable for movable in found.movables if movable.thing.emits]
    assert lamp.thing.name == name.replace(" ", "-")
    assert lamp.thing.hangs
    assert lamp.thing.at == pytest.approx([(low[0] + high[0]) / 2, (low[2] + high[2]) / 2, high[1]], abs=1e-3)
    assert lamp.box.low[2] == lamp.box.high[2] == lamp.thing.at[2]
    assert (lamp.box.high - lamp.box.low)[:2] == pytest.approx(reach, abs=0.15)
    emitting = [number for number, shape in enumerate(scene.shapes()) if shape.is_emitter()]
    assert set(found.shape[found.thing >= 0]) >= set(emitting)  # both sheets of a lamp with two sides
    assert not found.stays


def test_a_lamp_moves_with_what_it_stands_on_and_hangs_by(room: None, put: Put, gltf: Any, tmp_path: Path) -> None:
    put("LampFoot", (2.5, 0.75, 1.8), (2.6, 1.0, 1.9))
    put("Shade", (2.4, 1.0, 1.7), (2.7, 1.2, 2.0), light=9)
    put("Cable", (1.0, 2.0, 1.0), (1.02, 2.6, 1.02))
    put("Bulb", (0.95, 1.85, 0.95), (1.07, 1.97, 1.07), light=90)  # not touching its cable
    put("Pole", (4.2, 0, 0.5), (4.24, 1.5, 0.54))
    put("Glow", (4.1, 1.5, 0.4), (4.34, 1.7, 0.64), light=30)
    found, scene = proposed(gltf.write(), tmp_path)
    ids = [shape.id() for shape in scene.shapes()]
    parts = {m.thing.name: {ids[s] for s in found.shape[found.thing == n]} for n, m in enumerate(found.movables)}
    assert parts == {"Table": {"Table", "LampFoot", "Shade"}, "Bulb": {"Bulb", "Cable"}, "Glow": {"Pole", "Glow"}}
    assert [m.thing.name for m in found.movables if m.thing.hangs] == ["Bulb"]
    assert all(movable.thing.emits for movable in found.movables)


@pytest.mark.parametrize("at", [(4.2, 1.8, 0.8), (0.9, 1.05, 3.2)])
def test_a_lamp_stays_around_a_light_without_a_shape_and_it_is_said_why(
    room: None, put: Put, gltf: Any, tmp_path: Path, at: Any
) -> None:
    put("Foot", (4.05, 0, 0.65), (4.35, 1.3, 0.95))
    put("Shade", (4, 1.3, 0.6), (4.4, 1.6, 1))  # the light is 20 cm above it
    put("Desk", (0.5, 0, 3), (1.3, 0.75, 3.7))
    put("DeskLamp", (0.8, 0.75, 3.1), (1, 1, 3.3))  # a light is 5 cm above it
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "name": "Bulb"}]}}
    gltf.node("Bulb", translation=list(at), extensions={"KHR_lights_punctual": {"light": 0}})
    found, _ = proposed(gltf.write(), tmp_path)
    ((reason, staying),) = found.stays.items()
    assert "light that has no shape" in reason
    assert staying == (["Foot", "Shade"] if at[0] > 4 else ["Desk", "DeskLamp"])
    assert names(found) == (["Desk", "Table"] if at[0] > 4 else ["Foot", "Table"])


@pytest.mark.parametrize("height", [0.05, 1.9])
def test_nothing_is_proposed_to_stand_over_a_light_without_a_shape(tmp_path: Path, height: float) -> None:
    def cube(name: str, half: str, at: str, more: str = "") -> str:
        move = f"<scale value='{half}'/><translate value='{at}'/>"
        return f"<shape type='cube' id='{name}'><transform name='to_world'>{move}</transform>{more}</shape>"

    shell = cube("Shell", "2.5 1.3 2", "2.5 1.3 2", "<boolean name='flip_normals' value='true'/>")
    places = [(1.2, 1), (1.2, 3), (4, 1), (4, 3)]
    at = [f"<point name='position' x='{x}' y='{height}' z='{z}'/>" for x, z in places]
    points = [f"<emitter type='point'>{place}</emitter>" for place in at]
    file = tmp_path / "room.xml"
    content = "".join([shell, cube("Wardrobe", "0.3 0.95 0.3", "2.5 0.95 2"), *points])
    file.write_text(f"<scene version='3.0.0'>{content}</scene>")
    (movable,) = proposed(file, tmp_path)[0].movables
    low, high = (movable.box.low - movable.thing.size / 2)[:2], (movable.box.high + movable.thing.size / 2)[:2]
    assert (high - low > 0.7).all()
    assert all(((place < low) | (place > high)).any() for place in places)


def test_lights_in_walls_in_holes_and_as_large_as_the_ceiling_stay_and_it_is_said_why(
    put: Put, gltf: Any, tmp_path: Path
) -> None:
    put("Floor", (0, -0.2, 0), (5, 0, 4))
    for number, (low, high) in enumerate([((0, 0), (2, 4)), ((3, 0), (5, 4)), ((2, 0), (3, 1.5)), ((2, 2.1), (3, 4))]):
        put(f"Ceiling{number}", (low[0], 2.6, low[1]), (high[0], 2.8, high[1]))
    put("Slab", (0, 2.8, 0), (5, 3, 4))
    for number, (low, high) in enumerate([((-0.2, -0.2), (0, 4.2)), ((5, -0.2), (5.2, 4.2)), ((0, -0.2), (5, 0))]):
        put(f"Wall{number}", (low[0], 0, low[1]), (high[0], 2.6, high[1]))
    put("Window", (0, 0, 4), (5, 2.6, 4.1), light=1)
    put("Downlight", (2, 2.6, 1.5), (3, 2.6, 2.1), light=10)
    put("Sconce", (0, 1.5, 1.9), (0.4, 1.7, 2.1), light=10)
    put("Glowing", (0.2, 2.5, 0.2), (4.8, 2.5, 3.8), light=1)
    put("Table", (2, 0, 1.5), (3.2, 0.75, 2.2))
    found, _ = proposed(gltf.write(), tmp_path)
    assert names(found) == ["Table"]
    reasons = {name: reason for reason, names in found.stays.items() for name in names}
    for name, reason in (("Window", "wall"), ("Downlight", "hole"), ("Sconce", "stays"), ("Glowing", "large")):
        assert reason in reasons[name]


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, -1), (1, 0, 0)])
def test_frames_put_the_height_last_and_back(up: tuple[float, float, float]) -> None:
    frame, points = Frame(up), np.random.default_rng(0).normal(size=(5, 3))
    inside = frame.inward(points)
    assert inside[:, 2] == pytest.approx(points @ np.array(up))
    assert frame.world(inside) == pytest.approx(points)
    low, high = frame.box(Box(inside.min(axis=0), inside.max(axis=0)))
    assert [low, high] == pytest.approx(np.array([points.min(axis=0), points.max(axis=0)]))


def test_the_largest_rectangle_is_that_of_all_rectangles() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        free = rng.uniform(size=(7, 9)) < 0.8
        for row, column in np.argwhere(free)[::7]:
            (top, left), (bottom, right) = largest_rectangle(free, row, column)
            assert top <= row <= bottom
            assert left <= column <= right
            assert free[top : bottom + 1, left : right + 1].all()
            best = max(
                (b - t + 1) * (r - c + 1)
                for t in range(row + 1)
                for b in range(row, 7)
                for c in range(column + 1)
                for r in range(column, 9)
                if free[t : b + 1, c : r + 1].all()
            )
            assert (bottom - top + 1) * (right - left + 1) == best


def test_names_say_what_belongs_to_the_room_and_groups_have_them_as_far_as_a_spec_allows_it() -> None:
    assert [is_shell(name) for name in ("Walls_0001", "Ceiling fan", "Mesh12", "Mushrooms")] == [
        True,
        True,
        False,
        False,
    ]
    assert is_furniture("FloorLamp")
    assert not is_shell("FloorLamp")
    made = {"SofaLeather_0007": "SofaLeather_0007", "Chair.001": "Chair.001", "123": "123", "Tisch grün": "Tisch-grun"}
    for name, own in {**made, "椅子": "object"}.items():
        assert group_name(name) == own == TypeAdapter(Name).validate_python(own)
