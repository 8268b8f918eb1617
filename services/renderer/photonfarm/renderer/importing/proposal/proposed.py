"""The proposal: what moves where, the lights, and the boxes of cameras and of what they look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.proposal.floor_plan import FloorPlan, Mask
from photonfarm.renderer.importing.proposal.groups import CELL, Found, Thing, find_things
from photonfarm.renderer.importing.proposal.lamps import OUTSIDE, PLANE
from photonfarm.renderer.importing.proposal.pieces import Pieces
from photonfarm.renderer.importing.proposal.room import Room, extent_of, find_room, outdoors, trace
from photonfarm.renderer.importing.proposal.surfaces import Frame, Points, Surfaces
from photonfarm.renderer.scene.surroundings import LEAVING, NONE, surroundings
from photonfarm.shared.core.waiting import Log

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

MOST_ROOMS = 4
"""The most rooms that are looked into for something that may move."""

LOWEST = 0.75
"""The least height of such a light, as a share of the room's: lower things are furniture."""


class Box(NamedTuple):
    """A box in the frame."""

    low: Points  # (3,)
    high: Points  # (3,)


class Movable(NamedTuple):
    """A thing, and where it may be."""

    thing: Thing
    at: Points  # (3,): the middle of its lower side, where it stands in the file; of what hangs, of its upper side
    box: Box


class Ceiling(NamedTuple):
    """A rectangular light to add under the ceiling, in the middle of the box at first."""

    size: Points  # (2,)
    box: Box


class View(NamedTuple):
    """Where cameras may be, and what they look at."""

    origin: Box
    look_at: Box


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """All that a spec says of a scene beyond settings."""

    room: Room
    extent: Box  # of all that is there
    movables: list[Movable]
    views: list[View]  # the best first; the others are for scenes in which nothing of it is free
    light: Ceiling  # for a scene that has none, or too little
    stays: dict[str, list[str]]  # the names of lights that do not move, by the reason
    shape: NDArray[np.int32]  # (F,): the number of each triangle's shape
    thing: NDArray[np.int64]  # (F,): the number of the movable that it belongs to, or −1


def propose(scene: Any, frame: Frame, camera: Points | None, objects: Mapping[str, str], log: Log) -> Proposal:
    """The proposal for a Mitsuba scene; `camera` (3,) is that of the file, `objects` are the objects of shape ids.

    Raises SpecError for a scene of no extent.
    """
    surfaces = Surfaces.of(scene, frame)
    low, high = extent_of(surfaces)
    log(f"looking for the room and what stands in it, among {len(surfaces.shape)} triangles")
    room, pieces, found = _find(scene, surfaces, frame, camera, objects)
    moves = np.full(pieces.count, -1, np.int64)
    for number, thing in enumerate(found.things):
        moves[thing.pieces] = number
    extent = Box(low, high)
    views = _around(extent, frame, camera)
    if room.is_stage:
        light = _light(scene, frame, room, views[0].origin, None)
        return Proposal(room, extent, [], views, light, found.stays, surfaces.shape, moves[pieces.label])
    plan = FloorPlan.of(pieces, room, moves < 0)
    movables = [_movable(thing, plan, room) for thing in found.things]
    origin = _origin(plan, room, scene, frame)
    views.insert(0, View(origin, _look_at(movables, room, origin)))
    light = _light(scene, frame, room, origin, plan)
    return Proposal(room, extent, movables, views, light, found.stays, surfaces.shape, moves[pieces.label])


def _find(
    scene: Any, surfaces: Surfaces, frame: Frame, camera: Points | None, objects: Mapping[str, str]
) -> tuple[Room, Pieces, Found]:  # fmt: skip
    """The room and what is in it; of several in doubt the first in which there is something, or else all outdoors."""
    tried: list[Room] = []
    for last in [False] * MOST_ROOMS + [True]:
        room = outdoors(scene, surfaces, frame) if last else find_room(scene, surfaces, frame, camera, tried)
        pieces = Pieces.of(surfaces, CELL * room.height, float(room.size.max()))
        if room.is_stage:
            lights = [
                objects.get(name) or name for name, emits in zip(surfaces.ids, surfaces.emits, strict=True) if emits
            ]
            return room, pieces, Found([], {OUTSIDE: list(dict.fromkeys(lights))} if lights else {})
        found = find_things(pieces, surfaces, room, objects)
        if not room.is_doubtful or found.things:
            break
        tried.append(room)
    return room, pieces, found


def _around(extent: Box, frame: Frame, camera: Points | None) -> list[View]:
    """Cameras on each side of all that is there, that of the file's camera first, or else the front.

    On each they look into its middle, or at its surface alone, as all else of a solid is hidden.
    """
    (low, high), size = extent, extent.high - extent.low
    reach = float(size.max())
    front = np.array([0.0, -1.0 if frame.up[2] else 1.0]) if size[0] > 0.1 * size[1] else np.array([1.0, 0.0])
    towards = front if camera is None else (camera - (low + high) / 2)[:2]
    made = []
    for side in sorted(([0, 1], [0, -1], [1, 0], [-1, 0]), key=lambda side: -float(towards @ side)):
        axis, sign = int(side[0] == 0), sum(side)
        edge = (high if sign > 0 else low)[axis]
        first = np.array([*low[:2] - 0.5 * reach, low[2] + max(0.3 * size[2], 0.15 * reach)])
        last = high + 0.5 * reach
        first[axis], last[axis] = sorted(edge + sign * reach * np.array([0.3, 0.9]))
        surface = Box(low + 0.3 * size, high - 0.3 * size)
        surface.low[axis], surface.high[axis] = sorted(edge + sign * reach * np.array([0.02, 0.05]))
        made.append(View(Box(first, last), surface))
        if size[axis] > 0.1 * reach:
            made.insert(-1, View(Box(first, last), Box(low + 0.3 * size, high - 0.3 * size)))
    return made


def _light(scene: Any, frame: Frame, room: Room, origin: Box, plan: FloorPlan | None) -> Ceiling:
    """A light over the cameras where nothing is in its way, under what is above them."""
    middle = (origin.low + origin.high)[:2] / 2
    for share in (RECTANGLE, RECTANGLE / 2, RECTANGLE / 4):
        size = share * room.size[:2]
        place = plan and _place(plan, room, middle, size, room.high[2], room.high[2])
        if place:
            break
    first, last = place or (middle, middle)
    middle, reach = (first + last) / 2, (last - first + size) / 2
    steps = np.stack(np.meshgrid(*(np.linspace(-1, 1, 5),) * 2), axis=-1).reshape(-1, 2)
    start = np.column_stack([middle + steps * reach, np.full(len(steps), origin.high[2])])
    distance, _ = trace(scene, frame, start, np.tile([0.0, 0.0, 1.0], (len(start), 1)))
    lowest = room.floor + LOWEST * room.height
    height = float(np.clip(origin.high[2] + distance.min(), lowest, max(room.high[2], lowest))) - 0.01 * room.height
    return Ceiling(size, Box(np.array([*first, height]), np.array([*last, height])))


def _place(
    plan: FloorPlan, room: Room, middle: Points, size: Points, bottom: float, top: float, *, hangs: bool = True
) -> tuple[Points, Points] | None:  # fmt: skip
    """The corners (2,) of where the middle (2,) of something may be, near to where it is; None if nowhere."""
    clear = NEAR * room.height
    if hangs:
        top = min(top, room.high[2] - PLANE * room.height)
        bottom = min(bottom, top - clear)
    else:
        bottom += clear
    free = plan.free(bottom, top, size / 2, plan.ceiling if hangs else plan.floor)
    return plan.box_around(free, middle, RANGE * room.size[:2])


def _movable(thing: Thing, plan: FloorPlan, room: Room) -> Movable:
    """Where a thing may be: flat in height, and clear of all that does not move."""
    middle, height = (thing.low + thing.high)[:2] / 2, (thing.high if thing.hangs else thing.low)[2]
    place = _place(plan, room, middle, thing.size[:2], thing.low[2], thing.high[2], hangs=thing.hangs)
    low, high = (np.array([*corner, height]) for corner in place or (middle, middle))
    return Movable(thing, np.array([*middle, height]), Box(low, high))


def _origin(plan: FloorPlan, room: Room, scene: Any, frame: Frame) -> Box:
    """The largest box at the height of eyes that is free of what does not move, and inside the room."""
    low, high = (room.floor + share * room.height for share in EYES)
    margin = np.full(2, MARGIN * float(room.size[:2].min()))
    clear = plan.free(low, high, margin, plan.floor)
    wishes = [clear & _open(plan, room, scene, frame, (low, high)), clear]
    free = next((wish for wish in wishes if wish.any()), np.ones(plan.shape, np.bool_))
    found = plan.box_around(free, plan.widest_place(free), room.size[:2])
    first, last = found if found is not None else (room.low[:2], room.high[:2])
    return Box(np.array([*first, low]), np.array([*last, high]))


def _open(plan: FloorPlan, room: Room, scene: Any, frame: Frame, heights: tuple[float, ...]) -> Mask:
    """Where cameras stand in the open at all heights: inside no solid, not outside, and not behind something."""
    found = np.ones(plan.shape, np.bool_)
    for height in heights:
        places = np.concatenate([plan.middles, np.full((*plan.shape, 1), height)], axis=-1)
        around = surroundings(scene, frame.world(places.reshape(-1, 3)).astype(np.float32))
        inside = (around.leaving <= LEAVING) | (not room.has_ceiling)
        clear = around.clearance > CLEAR * room.height
        found &= ((around.solid == NONE) & inside & clear).reshape(plan.shape)
    return found


def _look_at(movables: list[Movable], room: Room, origin: Box) -> Box:
    """The box around what stands in the room, wherever it may stand; without any, around the middle of the floor."""
    low, high = (room.floor + share * room.height for share in LOOKS)
    standing = [m for m in movables if not m.thing.hangs]
    if room.subject is not None and not standing:
        lower, upper = room.subject
        beside = np.maximum(0.15 * (upper - lower), LOOKS[0] * room.size)  # so that some of it is in the open, and seen
        return Box(np.maximum(lower - beside, room.low), np.minimum(upper + beside, room.high))
    first, last = origin.low[:2], origin.high[:2]
    if standing:
        half = np.array([m.thing.size[:2] / 2 for m in standing])
        first = (np.array([m.box.low[:2] for m in standing]) - half).min(axis=0)
        last = (np.array([m.box.high[:2] for m in standing]) + half).max(axis=0)
    first, last = np.maximum(first, room.low[:2]), np.minimum(last, room.high[:2])
    middle, half = (first + last) / 2, TOWARDS_MIDDLE * (last - first) / 2
    return Box(np.array([*(middle - half), low]), np.array([*(middle + half), high]))
