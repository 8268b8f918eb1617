"""The proposal: what moves where, the lights, and the boxes of cameras and of what they look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.renderer.importing.proposal.floor_plan import FloorPlan, Mask
from photonfarm.renderer.importing.proposal.groups import Thing
from photonfarm.renderer.importing.proposal.pieces import Pieces
from photonfarm.renderer.importing.proposal.room import Room
from photonfarm.renderer.importing.proposal.surfaces import Frame, Points
from photonfarm.renderer.scene.surroundings import LEAVING, NONE, surroundings

RANGE = 0.25
"""How far a thing may go to each side, as a share of the room, so that arrangements stay sensible."""

EYES = (0.5, 0.72)
"""The heights of cameras, as shares of the room's: 1.35 m to 1.95 m in a room of 2.7 m."""

LOOKS = (0.04, 0.32)
"""The heights of what cameras look at: furniture, and not the ceiling."""

TOWARDS_MIDDLE = 0.65
"""What cameras look at is this share of where things may stand, around the middle: so that they show many."""

MARGIN = 0.05
"""The distance of cameras from what does not move, as a share of the room's shorter side."""

CLEAR = 0.05
"""The distance of cameras from any surface, as a share of the room's height."""

NEAR = 0.04
"""What lies lower than this share of the room's height above a thing's lower side is no obstacle: carpets, skirting."""

RECTANGLE = 0.25
"""The lengths of a ceiling light that is added, as a share of the room's."""

RADIANCE = (12.0, 11.0, 9.5)
"""The radiance of such a light: a warm white; the exposure follows it."""


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A box in the frame."""

    low: Points  # (3,)
    high: Points  # (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Movable:
    """A thing, and where it may be."""

    thing: Thing
    at: Points  # (3,): the middle of its lower side, where it stands in the file; of what hangs, of its upper side
    box: Box


@dataclass(frozen=True, slots=True, eq=False)
class Ceiling:
    """A rectangular light to add under the ceiling."""

    at: Points  # (3,)
    size: tuple[float, float]
    box: Box


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """All that a spec says of a scene beyond settings."""

    room: Room
    movables: list[Movable]
    origin: Box
    look_at: Box

    def ceiling_light(self) -> Ceiling:
        """A light for a scene that has none, or too little."""
        room = self.room
        size = RECTANGLE * room.size[:2]
        height = room.high[2] - 0.01 * room.height
        middle = (self.origin.low + self.origin.high)[:2] / 2
        reach = np.minimum(RANGE * room.size[:2], (self.origin.high - self.origin.low)[:2] / 2)
        at = np.array([*middle, height])
        box = Box(np.array([*(middle - reach), height]), np.array([*(middle + reach), height]))
        return Ceiling(at, (float(size[0]), float(size[1])), box)


def propose(pieces: Pieces, room: Room, things: list[Thing], scene: Any, frame: Frame) -> Proposal:
    """The proposal for a room and the things in it; `scene` is Mitsuba's, in which cameras are to stand in the open.

    Where there is no room nothing moves, and cameras stand in front.
    """
    if room.is_stage:
        return Proposal(room, [], *_in_front(room))
    moves = np.zeros(pieces.count, np.bool_)
    for thing in things:
        moves[thing.pieces] = True
    plan = FloorPlan.of(pieces, room, ~moves)
    movables = [_movable(thing, plan, room) for thing in things]
    origin = _origin(plan, room, scene, frame)
    return Proposal(room, movables, origin, _look_at(movables, room, origin))


def _in_front(room: Room) -> tuple[Box, Box]:
    """Cameras in front of what stands there, along the second axis, and the box that they look at."""
    size, reach = room.size, float(room.size.max())
    low = np.array([room.low[0] - 0.5 * reach, room.high[1] + 0.4 * reach, room.floor + 0.3 * size[2]])
    high = np.array([room.high[0] + 0.5 * reach, room.high[1] + 1.2 * reach, room.floor + size[2] + 0.5 * reach])
    return Box(low, high), Box(room.low + 0.3 * size, room.high - 0.3 * size)


def _movable(thing: Thing, plan: FloorPlan, room: Room) -> Movable:
    """Where a thing may be: flat in height, and clear of all that does not move."""
    middle = (thing.low + thing.high)[:2] / 2
    height = thing.high[2] if thing.hangs else thing.low[2]
    clear = NEAR * room.height
    free = plan.free(thing.low[2] + clear, thing.high[2] - (clear if thing.hangs else 0), thing.size[:2] / 2)
    found = plan.box_around(free, middle, RANGE * room.size[:2])
    low, high = (middle, middle) if found is None else found
    at = np.array([*middle, height])
    return Movable(thing, at, Box(np.array([*low, height]), np.array([*high, height])))


def _origin(plan: FloorPlan, room: Room, scene: Any, frame: Frame) -> Box:
    """The largest box at the height of eyes that is free of what does not move, and inside the room."""
    low, high = (room.floor + share * room.height for share in EYES)
    margin = np.full(2, MARGIN * float(room.size[:2].min()))
    wishes = [plan.free(low, high, margin) & _open(plan, room, scene, frame, (low, high)), plan.free(low, high, margin)]
    free = next((wish for wish in wishes if wish.any()), np.ones(plan.shape, np.bool_))
    found = plan.box_around(free, plan.widest_place(free), room.size[:2])
    first, last = found if found is not None else (room.low[:2], room.high[:2])
    return Box(np.array([*first, low]), np.array([*last, high]))


def _open(plan: FloorPlan, room: Room, scene: Any, frame: Frame, heights: tuple[float, ...]) -> Mask:
    """Where cameras stand in the open at all heights: inside no solid, not outside, and not behind something."""
    found = np.ones(plan.shape, np.bool_)
    for height in heights:
        around = surroundings(scene, frame.world(plan.places(height)).astype(np.float32))
        inside = (around.leaving <= LEAVING) | (not room.has_ceiling)
        clear = around.clearance > CLEAR * room.height
        found &= ((around.solid == NONE) & inside & clear).reshape(plan.shape)
    return found


def _look_at(movables: list[Movable], room: Room, origin: Box) -> Box:
    """The box around what stands in the room, wherever it may stand; without any, around the middle of the floor."""
    low, high = (room.floor + share * room.height for share in LOOKS)
    standing = [m for m in movables if not m.thing.hangs]
    first, last = origin.low[:2], origin.high[:2]
    if standing:
        half = np.array([m.thing.size[:2] / 2 for m in standing])
        first = (np.array([m.box.low[:2] for m in standing]) - half).min(axis=0)
        last = (np.array([m.box.high[:2] for m in standing]) + half).max(axis=0)
    first, last = np.maximum(first, room.low[:2]), np.minimum(last, room.high[:2])
    middle, half = (first + last) / 2, TOWARDS_MIDDLE * (last - first) / 2
    return Box(np.array([*(middle - half), low]), np.array([*(middle + half), high]))
