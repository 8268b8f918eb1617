"""The proposal for a room: what stands in it, where that may go, and where cameras are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pydantic import TypeAdapter

from photonfarm.renderer.importing.loading import load
from photonfarm.renderer.importing.proposal import surfaces
from photonfarm.renderer.importing.proposal.groups import group_name, is_furniture, is_shell
from photonfarm.renderer.importing.proposal.proposed import Proposal, largest_rectangle, propose
from photonfarm.renderer.importing.proposal.surfaces import Box, Frame
from photonfarm.renderer.importing.readers import reader_of
from photonfarm.renderer.scene.surroundings import surroundings
from photonfarm.shared.core.models import Name

SPEC_NAME = TypeAdapter(Name)
STRENGTH = "KHR_materials_emissive_strength"


def proposed(file: Path, scratch: Path) -> tuple[Proposal, Any]:
    """The proposal for a file, and its Mitsuba scene."""
    scene = reader_of(file)(file, scratch, lambda _: None)
    made, frame = load(scene, scratch, lambda _: None), Frame((0, 1, 0))
    camera = None if scene.camera is None else frame.inward(np.array(scene.camera))
    return propose(made, frame, camera, scene.objects, lambda _: None), made


@pytest.fixture(scope="module")
def proposal(boxes: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The proposal for the room of boxes, and its Mitsuba scene."""
    return proposed(boxes, tmp_path_factory.mktemp("scratch"))


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the points on surfaces, which is quicker."""
    monkeypatch.setattr(surfaces, "SAMPLES_PER_CELL", 1.3)


@pytest.fixture
def put(gltf: Any) -> Callable[..., None]:
    """Function (name, low, high, light, inwards) → adds a box, or a panel that faces down if it is flat."""

    def add(name: str, low: Any, high: Any, *, light: float = 0, inwards: bool = False) -> None:
        mesh = trimesh.creation.box(bounds=[low, np.add(high, (0, low[1] == high[1], 0))])
        if low[1] == high[1]:
            mesh.update_faces(mesh.face_normals[:, 1] < -0.5)
        if inwards:
            mesh.invert()
        look = {"emissiveFactor": [1, 1, 1], "extensions": {STRENGTH: {"emissiveStrength": light}}} if light else {}
        material = gltf.material(name, doubleSided=True, **look)
        gltf.node(name, gltf.mesh(mesh.vertices.astype("<f4"), mesh.faces.astype("<u4"), material))

    return add


@pytest.fixture
def room(put: Callable[..., None]) -> None:
    """A closed room of 5 × 4 × 2.6 with a table."""
    put("Shell", (0, 0, 0), (5, 2.6, 4), inwards=True)
    put("Table", (2, 0, 1.5), (3.2, 0.75, 2.2))


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


PANEL = ((2, 2.58, 1.5), (3, 2.58, 2.1))


@pytest.mark.parametrize(
    ("low", "high", "name"),
    [(*PANEL, "Panel"), ((2, 2.6, 1.5), (3, 2.6, 2.1), "Flush"), ((2, 2.5, 1.5), (3, 2.6, 2.1), "Ceiling light"),
     ((2.5, 1.8, 1.6), (2.8, 2.1, 1.9), "Globe")],
)  # fmt: skip
def test_a_lamp_moves_along_the_ceiling_where_it_hangs(
    room: None, put: Callable[..., None], gltf: Any, tmp_path: Path, low: Any, high: Any, name: str
) -> None:
    put(name, low, high, light=8)
    found, scene = proposed(gltf.write(), tmp_path)
    (lamp,) = [movable for movable in found.movables if movable.thing.emits]
    assert lamp.thing.name == name.replace(" ", "-")
    assert lamp.thing.hangs
    assert lamp.thing.at == pytest.approx([(low[0] + high[0]) / 2, (low[2] + high[2]) / 2, high[1]], abs=1e-3)
    assert lamp.box.low[2] == lamp.box.high[2] == lamp.thing.at[2]
    assert (lamp.box.high - lamp.box.low)[:2] == pytest.approx([2.5, 2], abs=0.15)
    emitting = [number for number, shape in enumerate(scene.shapes()) if shape.is_emitter()]
    assert set(found.shape[found.thing >= 0]) >= set(emitting)  # both sheets of a lamp with two sides
    assert not found.stays


def test_a_lamp_moves_with_what_it_stands_on_and_hangs_by(
    room: None, put: Callable[..., None], gltf: Any, tmp_path: Path
) -> None:
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


@pytest.mark.parametrize("at", [(4.2, 1.45, 0.8), (4.2, 1.8, 0.8), (0.9, 1.05, 3.2)])
def test_a_lamp_stays_around_a_light_without_a_shape_and_it_is_said_why(
    room: None, put: Callable[..., None], gltf: Any, tmp_path: Path, at: Any
) -> None:
    put("Foot", (4.05, 0, 0.65), (4.35, 1.3, 0.95))
    put("Shade", (4, 1.3, 0.6), (4.4, 1.6, 1))  # the light is in it, or 20 cm above it
    put("Desk", (0.5, 0, 3), (1.3, 0.75, 3.7))
    put("DeskLamp", (0.8, 0.75, 3.1), (1, 1, 3.3))  # a light is 5 cm above it
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "name": "Bulb"}]}}
    gltf.node("Bulb", translation=list(at), extensions={"KHR_lights_punctual": {"light": 0}})
    found, _ = proposed(gltf.write(), tmp_path)
    lamp, desk = ["Foot", "Shade"], ["Desk", "DeskLamp"]
    ((reason, names),) = found.stays.items()
    assert "light that has no shape" in reason
    assert names == (lamp if at[0] > 4 else desk)
    moves = sorted(movable.thing.name for movable in found.movables)
    assert moves == (["Desk", "Table"] if at[0] > 4 else ["Foot", "Table"])


@pytest.mark.parametrize("height", [0.05, 0.4, 1.9])
def test_nothing_is_proposed_to_stand_over_a_light_without_a_shape(tmp_path: Path, height: float) -> None:
    def cube(name: str, half: str, at: str, more: str = "") -> str:
        move = f"<scale value='{half}'/><translate value='{at}'/>"
        return f"<shape type='cube' id='{name}'><transform name='to_world'>{move}</transform>{more}</shape>"

    shell = cube("Shell", "2.5 1.3 2", "2.5 1.3 2", "<boolean name='flip_normals' value='true'/>")
    places = [(1.2, 1), (1.2, 3), (4, 1), (4, 3)]
    at = [f"x='{x}' y='{height}' z='{z}'" for x, z in places]
    points = [f"<emitter type='point'><point name='position' {place}/></emitter>" for place in at[:2]]
    spots = [
        f"<emitter type='spot'><transform name='to_world'><translate {place}/></transform></emitter>"
        for place in at[2:]
    ]
    file = tmp_path / "room.xml"
    content = "".join([shell, cube("Wardrobe", "0.3 0.95 0.3", "2.5 0.95 2"), *points, *spots])
    file.write_text(f"<scene version='3.0.0'>{content}</scene>")
    (movable,) = proposed(file, tmp_path)[0].movables
    low, high = (movable.box.low - movable.thing.size / 2)[:2], (movable.box.high + movable.thing.size / 2)[:2]
    assert (high - low > 0.7).all()
    assert all(((place < low) | (place > high)).any() for place in places)


def test_a_tube_moves_though_it_is_nearly_as_long_as_the_room(
    room: None, put: Callable[..., None], gltf: Any, tmp_path: Path
) -> None:
    put("Tube", (0.5, 2.5, 1.95), (4.5, 2.56, 2.05), light=8)
    found, _ = proposed(gltf.write(), tmp_path)
    (lamp,) = [movable for movable in found.movables if movable.thing.emits]
    assert (lamp.box.high - lamp.box.low)[:2] == pytest.approx([0.8, 2], abs=0.15)


def test_lights_in_walls_in_holes_and_as_large_as_the_ceiling_stay_and_it_is_said_why(
    put: Callable[..., None], gltf: Any, tmp_path: Path
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
    assert [movable.thing.name for movable in found.movables] == ["Table"]
    reasons = {name: reason for reason, names in found.stays.items() for name in names}
    assert "wall" in reasons["Window"]
    assert "hole" in reasons["Downlight"]
    assert "stays" in reasons["Sconce"]
    assert "large" in reasons["Glowing"]


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
                for t in range(row + 1) for b in range(row, 7) for c in range(column + 1) for r in range(column, 9)
                if free[t : b + 1, c : r + 1].all()
            )  # fmt: skip
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
