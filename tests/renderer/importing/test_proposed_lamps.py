"""Which lamps of a file are proposed to move, and why others stay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from imported_scenes import proposed

pytestmark = pytest.mark.usefixtures("few_points")

PANEL = ((2, 2.58, 1.5), (3, 2.58, 2.1))


@pytest.mark.parametrize(
    ("low", "high", "name"),
    [
        (*PANEL, "Panel"),
        ((2, 2.6, 1.5), (3, 2.6, 2.1), "Flush"),
        ((2, 2.5, 1.5), (3, 2.6, 2.1), "Ceiling light"),
        ((2.5, 1.8, 1.6), (2.8, 2.1, 1.9), "Globe"),
    ],
)
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
