"""The proposal for a room: what stands in it, where that may go, and where cameras are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from photonfarm.renderer.importing.importer import _proposal
from photonfarm.renderer.importing.loading import load
from photonfarm.renderer.importing.proposal.floor_plan import largest_rectangle
from photonfarm.renderer.importing.proposal.names import group_name, is_furniture, is_shell
from photonfarm.renderer.importing.proposal.surfaces import Frame
from photonfarm.renderer.importing.readers import reader_of
from photonfarm.renderer.scene.surroundings import surroundings


def proposed(file: Path, scratch: Path) -> Any:
    """The proposal for a file, and its Mitsuba scene."""
    scene = reader_of(file)(file, scratch, lambda _: None)
    made = load(scene, scratch, lambda _: None)
    return (*_proposal(scene, made, Frame((0, 1, 0)), lambda _: None), made)


@pytest.fixture(scope="module")
def proposal(boxes: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The proposal for the room of boxes."""
    return proposed(boxes, tmp_path_factory.mktemp("scratch"))


def test_the_room_is_found_and_all_that_stands_in_it_also_two_chairs_of_one_mesh(proposal: Any) -> None:
    found, things, belonging, _ = proposal
    assert found.room.low == pytest.approx([0, 0, 0], abs=0.01)
    assert found.room.high == pytest.approx([5, 4, 2.6], abs=0.01)
    assert found.room.has_ceiling
    assert sorted(thing.name for thing in things) == ["chairs", "chairs-2", "table", "wardrobe"]
    chairs = [number for number, thing in enumerate(things) if thing.name.startswith("chairs")]
    for number in chairs:
        assert (belonging.thing == number).sum() == 12
        assert len(set(belonging.shape[belonging.thing == number])) == 1


@pytest.mark.parametrize(("name", "count"), [("Stool.2", 1), ("Basket", 2)])
def test_parts_of_one_name_are_one_thing_without_touching_and_a_sheet_is_none(
    gltf: Any, tmp_path: Path, name: str, count: int
) -> None:
    shell = trimesh.creation.box(bounds=[[0, 0, 0], [5, 2.6, 4]])
    outer = trimesh.creation.box(bounds=[[3, 0, 2], [3.6, 0.6, 2.6]])
    inner = trimesh.creation.box(bounds=[[3.1, 0, 2.1], [3.5, 0.5, 2.5]])
    sheet = trimesh.creation.box(bounds=[[1, 0, 1], [1.01, 0.8, 1.6]])
    shell.invert()
    for own, mesh in (("Shell", shell), ("Stool.1", outer), (name, inner), ("Sheet", sheet)):
        gltf.node(own, gltf.mesh(mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")))
    _, things, _, _ = proposed(gltf.write(), tmp_path)
    assert len(things) == count


def test_things_stay_inside_the_room_on_the_floor_wherever_they_may_be(proposal: Any) -> None:
    found, _, _, _ = proposal
    for movable in found.movables:
        half = movable.thing.size[:2] / 2
        assert (movable.box.low[:2] - half >= found.room.low[:2] - 1e-6).all()
        assert (movable.box.high[:2] + half <= found.room.high[:2] + 1e-6).all()
        assert movable.box.low[2] == movable.box.high[2] == movable.at[2] == pytest.approx(0, abs=1e-6)
        assert (movable.box.high[:2] > movable.box.low[:2]).all()


def test_cameras_stand_in_the_open_and_look_at_what_stands_there(proposal: Any) -> None:
    found, things, _, scene = proposal
    rng = np.random.default_rng(0)
    at = rng.uniform(found.origin.low, found.origin.high, (200, 3))
    around = surroundings(scene, Frame((0, 1, 0)).world(at).astype(np.float32))
    assert around.open.mean() == 1
    middles = np.array([(thing.low + thing.high) / 2 for thing in things])
    assert (found.look_at.high > found.look_at.low).all()
    assert ((found.look_at.low < middles.mean(axis=0)) & (middles.mean(axis=0) < found.look_at.high))[:2].all()
    assert found.look_at.high[2] < found.origin.low[2]


def test_a_light_to_add_hangs_below_the_ceiling(proposal: Any) -> None:
    found, _, _, _ = proposal
    light = found.ceiling_light()
    assert 2.5 < light.at[2] < 2.6
    half = np.array(light.size) / 2
    assert (light.box.low[:2] - half > 0).all()
    assert (light.box.high[:2] + half < found.room.high[:2]).all()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0)])
def test_frames_put_the_height_last_and_back(up: tuple[float, float, float]) -> None:
    frame, points = Frame(up), np.random.default_rng(0).normal(size=(5, 3))
    inside = frame.inward(points)
    assert inside[:, 2] == pytest.approx(points @ np.array(up))
    assert frame.world(inside) == pytest.approx(points)
    low, high = frame.box(inside.min(axis=0), inside.max(axis=0))
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
    [("Walls_0001", True, False), ("FloorLamp", False, True), ("Mesh12", False, False), ("Ceiling fan", True, False)],
)
def test_names_say_what_belongs_to_the_room(name: str, shell: bool, furniture: bool) -> None:
    assert is_shell(name) == shell
    assert is_furniture(name) == furniture


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("SofaLeather_0007", "sofa-leather"),
        ("Chair.001", "chair"),
        ("Chair_2.001", "chair"),
        ("123", "object"),
        ("Tisch grün", "tisch-gr-n"),
    ],
)
def test_groups_have_names_that_a_spec_allows(name: str, made: str) -> None:
    assert group_name(name) == made
