"""The proposal: what moves where, the lights, and the boxes of cameras and of what they look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photonfarm.core.waiting import Log
from photonfarm.renderer.scene.surroundings import LEAVING, NONE, surroundings
from photonfarm.renderer.tools.importing.proposal.groups import PLANE, Found, Thing, find_things
from photonfarm.renderer.tools.importing.proposal.room import NEAR_FLOOR, Room, find_room, outdoors, trace
from photonfarm.renderer.tools.importing.proposal.surfaces import Box, Frame, Pieces, Points, Surfaces

Mask = NDArray[np.bool_]

# Shares of the room's height, where nothing else is said.
RANGE = 0.25  # of the room: how far a thing may go to each side, so that arrangements stay sensible
EYES = (0.5, 0.72)  # the heights of cameras: 1.35 m to 1.95 m in a room of 2.7 m
LOOKS = (0.04, 0.32)  # the heights of what cameras look at: furniture, and not the ceiling
TOWARDS_MIDDLE = 0.65  # of where things may stand: what cameras look at, around the middle, so that they show many
MARGIN = 0.05  # of the room's shorter side: the distance of cameras from what does not move
CLEAR = 0.05  # the distance of cameras from any surface
NEAR = 0.04  # what lies less above a thing's lower side is no obstacle: carpets, skirting
RECTANGLE = 0.25  # of the room: the lengths of a ceiling light that is added
LOWEST = 0.75  # the least height of such a light: lower things are furniture

RADIANCE = (12.0, 11.0, 9.5)
"""The radiance of such a light: a warm white; the exposure follows it."""

CELLS = 96
"""Cells of the floor plan along the longer side of the room."""

MOST_ROOMS = 4
"""The most rooms that are looked into for something that may move."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """The grid, and the points on everything that does not move."""

    room: Room
    fixed: Points  # (M, 3)
    flat: Mask  # (M,): which of them lie on what is level
    lights: Points  # (L, 3): where lights without a shape are
    cell: float
    shape: tuple[int, int]

    @classmethod
    def of(cls, pieces: Pieces, room: Room, fixed_pieces: Mask, lights: Points) -> Self:
        """The plan of a room; `fixed_pieces` (N,) are those that do not move."""
        cell = float(room.size[:2].max()) / CELLS
        a, b = (int(n) for n in np.maximum(np.ceil(room.size[:2] / cell), 1))
        chosen = fixed_pieces[pieces.sample_piece]
        return cls(room, pieces.sample[chosen], pieces.sample_flat[chosen], lights, cell, (a, b))

    def _mark(self, points: Points) -> Mask:
        place = np.floor((points[:, :2] - self.room.low[:2]) / self.cell).astype(np.int64)
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        mask: Mask = np.zeros(self.shape, np.bool_)
        mask[tuple(place[inside].T)] = True
        return mask

    def blocks(self, points: Points, half: Points) -> Mask:
        """Where a box of half-lengths `half` (2,), by its middle, holds one of the points, or leaves the room."""
        size = 2 * np.ceil(half / self.cell).astype(int) + 1
        return np.asarray(ndimage.maximum_filter(self._mark(points), size=tuple(size), mode="constant", cval=1))

    def free(self, bottom: float, top: float, half: Points, level: float) -> Mask:
        """Where the middle of a box of half-lengths `half` (2,) may be: at a floor or ceiling, and nothing in its way.

        `level` is the height of that, which may have small gaps, and does not count if there is next to none.
        """
        height = self.fixed[:, 2]
        blocked = self.blocks(self.fixed[(height > bottom) & (height < top)], half)
        there = self._mark(self.fixed[self.flat & (np.abs(height - level) < NEAR_FLOOR * self.room.height)])
        there |= ndimage.binary_closing(there, iterations=2, border_value=0)
        free: Mask = ~blocked & (there | (there.mean() <= 0.05))
        return free

    def box_around(self, free: Mask, point: Points, reach: Points) -> tuple[Points, Points] | None:
        """The largest free rectangle around the free place nearest to a point, up to `reach` (2,) from it.

        Its corners (2,), which are middles of cells; None if no free place is within reach.
        """
        away = np.abs(self.middles - point)
        near = free & (away <= reach).all(axis=-1)
        if not near.any():
            return None
        nearest = np.argmin(np.where(near, np.hypot(away[..., 0], away[..., 1]), np.inf))
        first, last = largest_rectangle(near, *(int(n) for n in np.unravel_index(nearest, near.shape)))
        return self.middles[first], self.middles[last]

    @property
    def middles(self) -> Points:
        """The middles of all cells, (A, B, 2)."""
        return self.room.low[:2] + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.cell

    def widest_place(self, free: Mask) -> Points:
        """The point (2,) that is farthest from whatever is not free."""
        depth = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
        place: Points = self.middles[np.unravel_index(int(np.argmax(depth)), free.shape)]
        return place


class Movable(NamedTuple):
    """A thing, and where its `at` may be."""

    thing: Thing
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
    stays: dict[str, list[str]]  # the names of lights that do not move, and of what stays with one, by the reason
    has_others: bool  # whether things stand in other rooms, too
    shape: NDArray[np.int32]  # (F,): the number of each triangle's shape
    thing: NDArray[np.int64]  # (F,): the number of the movable that it belongs to, or −1


def propose(scene: Any, frame: Frame, camera: Points | None, objects: Mapping[str, str], log: Log) -> Proposal:
    """The proposal for a Mitsuba scene; `camera` (3,) is that of the file, `objects` are the objects of shape ids.

    Raises SpecError for a scene of no extent.
    """
    surfaces = Surfaces.of(scene, frame)
    log(f"looking for the room and what stands in it, among {len(surfaces.shape)} triangles")
    (room, pieces, things, stays), has_others = _find(scene, surfaces, frame, camera, objects)
    moves = np.full(len(pieces.shape), -1, np.int64)
    for number, thing in enumerate(things):
        moves[thing.pieces] = number
    views = _around(surfaces.main(), frame, camera)
    plan, movables = None, list[Movable]()
    if not room.is_stage:
        plan = FloorPlan.of(pieces, room, moves < 0, surfaces.lights)
        for thing in things:  # flat in height, and clear of all that does not move
            at = thing.at
            place = _place(plan, at[:2], thing.size[:2], thing.low[2], thing.high[2], hangs=thing.hangs)
            low, high = (np.array([*corner, at[2]]) for corner in place or (at[:2], at[:2]))
            movables.append(Movable(thing, Box(low, high)))
        origin = _origin(plan, scene, frame)
        views.insert(0, View(origin, _look_at(movables, room, origin)))
    light = _light(scene, frame, room, views[0].origin, plan)
    thing_of = moves[pieces.label]
    return Proposal(room, surfaces.extent, movables, views, light, stays, has_others, surfaces.shape, thing_of)


def _find(
    scene: Any, surfaces: Surfaces, frame: Frame, camera: Points | None, objects: Mapping[str, str]
) -> tuple[Found, bool]:
    """The room with what is in it, and whether things stand in others, too.

    Of rooms in doubt it is that with the largest area that may move; if nothing may move, it is all outdoors.
    """
    tried: list[Found] = []
    for _ in range(MOST_ROOMS):
        room = find_room(scene, surfaces, frame, camera, [each.room for each in tried])
        if not room.is_doubtful:
            break
        tried.append(find_things(surfaces, room, objects))
    if not any(each.things for each in tried):
        return find_things(surfaces, outdoors(scene, surfaces, frame) if tried else room, objects), False
    best = max(tried, key=lambda each: each.pieces.area[[*each.moving]].sum())
    return best, any(each.moving - best.moving for each in tried)


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
    middle, size = (origin.low + origin.high)[:2] / 2, RECTANGLE * room.size[:2]
    place = plan and _place(plan, middle, size, room.high[2], room.high[2], hangs=True)
    first, last = place or (middle, middle)
    middle, reach = (first + last) / 2, (last - first + size) / 2
    steps = np.stack(np.meshgrid(*(np.linspace(-1, 1, 5),) * 2), axis=-1).reshape(-1, 2)
    start = np.column_stack([middle + steps * reach, np.full(len(steps), origin.high[2])])
    distance, _ = trace(scene, frame, start, np.tile([0.0, 0.0, 1.0], (len(start), 1)))
    lowest = room.floor + LOWEST * room.height
    height = float(np.clip(origin.high[2] + distance.min(), lowest, max(room.high[2], lowest))) - 0.01 * room.height
    return Ceiling(size, Box(np.array([*first, height]), np.array([*last, height])))


def _place(
    plan: FloorPlan, middle: Points, size: Points, bottom: float, top: float, *, hangs: bool
) -> tuple[Points, Points] | None:
    """The corners (2,) of where the middle (2,) of something may be, near to where it is; None if nowhere."""
    room, clear, height = plan.room, NEAR * plan.room.height, plan.lights[:, 2]
    lights = plan.lights[(height > bottom - clear) & (height < top + clear)]
    if hangs:
        top = min(top, room.high[2] - PLANE * room.height)
        bottom = min(bottom, top - clear)
    else:
        bottom += clear
    free = plan.free(bottom, top, size / 2, room.high[2] if hangs else room.floor) & ~plan.blocks(lights, size / 2)
    return plan.box_around(free, middle, RANGE * room.size[:2])


def _origin(plan: FloorPlan, scene: Any, frame: Frame) -> Box:
    """The largest box at the height of eyes that is free of what does not move, and inside the room."""
    room = plan.room
    low, high = (room.floor + share * room.height for share in EYES)
    clear = plan.free(low, high, np.full(2, MARGIN * float(room.size[:2].min())), room.floor)
    wishes = [clear & _find_open(plan, scene, frame, (low, high)), clear, np.ones_like(clear)]
    free = next(wish for wish in wishes if wish.any())
    box = plan.box_around(free, plan.widest_place(free), room.size[:2])
    first, last = box or (room.low[:2], room.high[:2])
    return Box(np.array([*first, low]), np.array([*last, high]))


def _find_open(plan: FloorPlan, scene: Any, frame: Frame, heights: tuple[float, ...]) -> Mask:
    """Where cameras stand in the open at all heights: inside no solid, not outside, and not behind something."""
    free, room = np.ones(plan.shape, np.bool_), plan.room
    for height in heights:
        places = np.concatenate([plan.middles, np.full((*plan.shape, 1), height)], axis=-1)
        around = surroundings(scene, frame.world(places.reshape(-1, 3)).astype(np.float32))
        inside = (around.leaving <= LEAVING) | (not room.has_ceiling)
        clear = around.clearance > CLEAR * room.height
        free &= ((around.solid == NONE) & inside & clear).reshape(plan.shape)
    return free


def _look_at(movables: list[Movable], room: Room, origin: Box) -> Box:
    """The box around what stands in the room, wherever it may stand; without any, around the middle of the floor."""
    low, high = (room.floor + share * room.height for share in LOOKS)
    standing = [(box, thing.size / 2) for thing, box in movables if not thing.hangs]
    if room.subject is not None and not standing:
        lower, upper = room.subject
        beside = np.maximum(0.15 * (upper - lower), LOOKS[0] * room.size)  # so that some of it is in the open, and seen
        return Box(np.maximum(lower - beside, room.low), np.minimum(upper + beside, room.high))
    first, last = origin.low[:2], origin.high[:2]
    if standing:
        first = np.min([box.low - half for box, half in standing], axis=0)[:2]
        last = np.max([box.high + half for box, half in standing], axis=0)[:2]
    first, last = np.maximum(first, room.low[:2]), np.minimum(last, room.high[:2])
    middle, half = (first + last) / 2, TOWARDS_MIDDLE * (last - first) / 2
    return Box(np.array([*(middle - half), low]), np.array([*(middle + half), high]))


def largest_rectangle(free: Mask, row: int, column: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The first and last cells of the largest rectangle of free cells that contains a free one."""
    best, corners = 0, ((row, column), (row, column))
    for first in range(row, -1, -1):
        for last in range(row, free.shape[0]):
            blocked = np.flatnonzero(~free[first : last + 1].all(axis=0))
            left = int(blocked[blocked < column].max(initial=-1)) + 1
            right = int(blocked[blocked >= column].min(initial=free.shape[1])) - 1
            if right < column:
                break
            area = (last - first + 1) * (right - left + 1)
            if area > best:
                best, corners = area, ((first, left), (last, right))
    return corners
