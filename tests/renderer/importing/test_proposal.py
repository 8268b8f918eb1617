"""The proposal for a room: what stands in it, where that may go, and where cameras are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from imported_scenes import proposed
from pydantic import TypeAdapter

from photonfarm.core.models import Name
from photonfarm.renderer.scene.surroundings import surroundings
from photonfarm.renderer.tools.importing.proposal import surfaces
from photonfarm.renderer.tools.importing.proposal.groups import group_name, is_furniture, is_shell
from photonfarm.renderer.tools.importing.proposal.proposed import largest_rectangle
from photonfarm.renderer.tools.importing.proposal.surfaces import Box, Frame

pytestmark = pytest.mark.usefixtures("few_points")

SPEC_NAME = TypeAdapter(Name)


@pytest.fixture(scope="module")
def proposal(boxes: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The proposal for the room of boxes, and its Mitsuba scene."""
    return proposed(boxes, tmp_path_factory.mktemp("scratch"))


def test_the_room_is_found_and_all_that_stands_in_it_also_two_chairs_of_one_mesh(proposal: Any) -> None:
    found, _ = proposal
    assert found.room.low == pytest.approx([0, 0, 0], abs=0.01)
    assert found.room.high == pytest.approx([5, 4, 2.6], abs=0.01)
    assert found.room.has_ceiling
    names = [movable.thing.name for movable in found.movables]
    assert sorted(names) == ["Chairs", "Chairs-2", "Table", "Wardrobe"]
    for number in [number for number, name in enumerate(names) if name.startswith("Chairs")]:
        assert (found.thing == number).sum() == 12
        assert len(set(found.shape[found.thing == number])) == 1


def test_a_box_in_another_one_is_a_thing_of_its_own_and_a_sheet_is_none(gltf: Any, tmp_path: Path) -> None:
    shell = trimesh.creation.box(bounds=[[0, 0, 0], [5, 2.6, 4]])
    outer = trimesh.creation.box(bounds=[[3, 0, 2], [3.6, 0.6, 2.6]])
    inner = trimesh.creation.box(bounds=[[3.1, 0, 2.1], [3.5, 0.5, 2.5]])
    sheet = trimesh.creation.box(bounds=[[1, 0, 1], [1.01, 0.8, 1.6]])
    shell.invert()
    for own, mesh in (("Shell", shell), ("Stool", outer), ("Basket", inner), ("Sheet", sheet)):
        gltf.node(own, gltf.mesh(mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")))
    found, _ = proposed(gltf.write(), tmp_path)
    assert sorted(movable.thing.name for movable in found.movables) == ["Basket", "Stool"]


def test_things_stay_inside_the_room_on_the_floor_wherever_they_may_be(proposal: Any) -> None:
    found, _ = proposal
    for movable in found.movables:
        half = movable.thing.size[:2] / 2
        assert (movable.box.low[:2] - half >= found.room.low[:2] - 1e-6).all()
        assert (movable.box.high[:2] + half <= found.room.high[:2] + 1e-6).all()
        assert movable.box.low[2] == movable.box.high[2] == movable.thing.at[2] == pytest.approx(0, abs=1e-6)
        assert (movable.box.high[:2] > movable.box.low[:2]).all()


def test_cameras_stand_in_the_open_and_look_at_what_stands_there(proposal: Any) -> None:
    found, scene = proposal
    rng = np.random.default_rng(0)
    origin, look_at = found.views[0]
    at = rng.uniform(origin.low, origin.high, (200, 3))
    around = surroundings(scene, Frame((0, 1, 0)).world(at).astype(np.float32))
    assert around.open.mean() == 1
    middles = np.array([(movable.thing.low + movable.thing.high) / 2 for movable in found.movables])
    assert (look_at.high > look_at.low).all()
    assert ((look_at.low < middles.mean(axis=0)) & (middles.mean(axis=0) < look_at.high))[:2].all()
    assert look_at.high[2] < origin.low[2]


def test_a_light_to_add_hangs_below_the_ceiling(proposal: Any) -> None:
    light = proposal[0].light
    assert 2.5 < light.box.low[2] == light.box.high[2] < 2.6
    assert (light.box.low[:2] - light.size / 2 > 0).all()
    assert (light.box.high[:2] + light.size / 2 < [5, 4]).all()


@pytest.mark.parametrize("far", [12, 300])
def test_lights_and_strays_far_above_a_room_without_a_ceiling_do_not_make_it_high(
    put: Callable[..., None], gltf: Any, tmp_path: Path, far: float
) -> None:
    put("Floor", (0, -0.1, 0), (5, 0, 4))
    for number, (low, high) in enumerate(
        [((-0.1, 0), (0, 4)), ((5, 0), (5.1, 4)), ((0, -0.1), (5, 0)), ((0, 4), (5, 4.1))]
    ):
        put(f"Wall{number}", (low[0], 0, low[1]), (high[0], 2.6, high[1]))
    put("Table", (2, 0, 1.5), (3.2, 0.75, 2.2))
    put("Sun", (2, far, 2), (2.5, far + 0.5, 2.5), light=9)
    put("Stray", (2, far + 1, 2), (2.5, far + 1.5, 2.5))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.height < 4
    assert found.views[0].origin.high[2] < 2.6
    assert [movable.thing.name for movable in found.movables] == ["Table"]


def test_a_ball_has_few_triangles() -> None:
    import mitsuba as mi

    ball = surfaces.Surfaces.of(mi.load_dict({"type": "scene", "ball": {"type": "sphere"}}), Frame((0, 1, 0)))
    assert len(ball.shape) < 1000
    assert ball.area.sum() == pytest.approx(4 * np.pi, rel=0.02)


@pytest.mark.parametrize("ground", [5, 500])
def test_a_cube_on_a_floor_is_no_room_and_cameras_look_down_on_it(
    put: Callable[..., None], gltf: Any, tmp_path: Path, ground: float
) -> None:
    put("Cube", (-0.5, 0, -0.5), (0.5, 1, 0.5))
    put("Floor", (-ground, 0, -ground), (ground, 0, ground))
    found, scene = proposed(gltf.write(), tmp_path)
    assert not found.room.has_ceiling
    assert [movable.thing.name for movable in found.movables] == ["Cube"]
    origin, look_at = found.views[0]
    at = np.random.default_rng(0).uniform(origin.low, origin.high, (200, 3))
    assert (surroundings(scene, Frame((0, 1, 0)).world(at).astype(np.float32)).solid < 0).all()
    assert 1 < origin.low[2] < origin.high[2] < 3
    assert np.abs([*origin, *look_at])[:, :2].max() < 3


def test_of_closed_rooms_the_one_with_something_in_it_is_shown(
    put: Callable[..., None], gltf: Any, tmp_path: Path
) -> None:
    put("Large", (0, 0, 0), (4, 2.6, 4), inwards=True)
    put("Small", (4.2, 0, 0), (7.2, 2.6, 4), inwards=True)
    put("Sofa", (5, 0, 1), (6.4, 0.8, 1.9))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.low[0] == pytest.approx(4.2, abs=0.02)
    assert [movable.thing.name for movable in found.movables] == ["Sofa"]


def test_of_rooms_with_furniture_that_with_most_is_shown_and_it_is_said_that_there_are_others(
    put: Callable[..., None], gltf: Any, tmp_path: Path
) -> None:
    put("Bedroom", (0, 0, 0), (4, 2.6, 4), inwards=True)
    put("Bed", (1, 0, 1), (2.8, 0.5, 2.8))
    put("Globe", (2, 2, 2), (2.3, 2.3, 2.3), light=9)
    put("Living", (4.2, 0, 0), (7.2, 2.6, 4), inwards=True)
    put("Sofa", (5, 0, 1), (6.4, 0.8, 1.9))
    put("Board", (5, 0, 2.8), (6.6, 1.6, 3.3))
    found, _ = proposed(gltf.write(), tmp_path)
    assert [movable.thing.name for movable in found.movables] == ["Board", "Sofa"]
    assert found.has_others
    assert found.stays == {"outside the room": ["Globe"]}


@pytest.mark.parametrize(("furnished", "ground"), [(True, 300), (False, 15)])
def test_a_furnished_room_on_a_large_ground_is_seen_from_within_and_an_empty_one_from_outside(
    put: Callable[..., None], gltf: Any, tmp_path: Path, furnished: bool, ground: float
) -> None:
    put("Inner", (-3.1, 0, -1.8), (3.1, 2.5, 1.8), inwards=True)
    put("Outer", (-3.2, -0.02, -1.9), (3.2, 2.6, 1.9))
    put("Lawn", (-ground, -0.06, -ground), (ground, -0.04, ground))
    if furnished:
        put("Table", (-0.5, 0, -0.5), (0.5, 0.7, 0.5))
    found, _ = proposed(gltf.write(), tmp_path)
    assert found.room.has_ceiling == furnished
    assert [movable.thing.name for movable in found.movables] == ["Table"] * furnished
    assert not found.has_others


def test_what_is_close_to_a_wall_and_does_not_reach_it_is_no_part_of_it(
    room: None, put: Callable[..., None], gltf: Any, tmp_path: Path
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
    assert [movable.thing.name for movable in found.movables] == ["Table"]


@pytest.mark.parametrize("camera", [None, (0, 1, -9), (9, 1, 0)])
def test_a_house_alone_is_seen_from_outside_from_the_side_of_the_camera(
    put: Callable[..., None], gltf: Any, tmp_path: Path, camera: Any
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


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0)])
def test_frames_put_the_height_last_and_back(up: tuple[float, float, float]) -> None:
    frame, points = Frame(up), np.random.default_rng(0).normal(size=(5, 3))
    inside = frame.inward(points)
    assert inside[:, 2] == pytest.approx(points @ np.array(up))
    assert frame.world(inside) == pytest.approx(points)
    low, high = frame.box(Box(inside.min(axis=0), inside.max(axis=0)))
    assert low == pytest.approx(points.min(axis=0))
    assert high == pytest.approx(points.max(axis=0))


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


@pytest.mark.parametrize(
    ("name", "shell", "furniture"),
    [
        ("Walls_0001", True, False),
        ("FloorLamp", False, True),
        ("Mesh12", False, False),
        ("Ceiling fan", True, False),
        ("Mushrooms", False, False),
    ],
)
def test_names_say_what_belongs_to_the_room(name: str, shell: bool, furniture: bool) -> None:
    assert is_shell(name) == shell
    assert is_furniture(name) == furniture


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("SofaLeather_0007", "SofaLeather_0007"),
        ("Chair.001", "Chair.001"),
        ("Chair2", "Chair2"),
        ("123", "123"),
        ("Tisch grün", "Tisch-grun"),
        ("椅子", "object"),
    ],
)
def test_groups_have_the_names_of_the_file_as_far_as_a_spec_allows_them(name: str, made: str) -> None:
    assert group_name(name) == made
    assert SPEC_NAME.validate_python(made) == made
