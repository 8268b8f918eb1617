"""What stands in a room as one thing, and what is the room itself. Letters: N pieces, T things."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.proposal.names import group_name, is_furniture, is_shell
from photonfarm.renderer.importing.proposal.pieces import Labels, Pieces, numbered
from photonfarm.renderer.importing.proposal.room import Room
from photonfarm.renderer.importing.proposal.surfaces import Points, Surfaces

CELL = 1 / 150
"""The distance up to which surfaces touch, as a share of the room's height: 1.8 cm in a room of 2.7 m."""

FLAT, CARPET = 0.03, 0.25
"""What rises less than the first share of the room's height above the floor, and is longer than the second one, is a
carpet, and part of the room."""

STANDS = 0.04
"""What begins below this share of the room's height stands on the floor."""

WALL = 0.03
"""What has its middle within this share of a side, or beyond it, is part of the wall."""

TALL, WIDE = 0.88, 0.6
"""What is taller or wider than these shares of the room is part of it."""

SMALL = 0.1
"""What is shorter than this share of the room's height in two directions stands for nothing by itself."""

SHEET = 0.01
"""What is thinner than this share of the room's height is a part of something, such as the door of a cupboard."""

FLOATS = 0.08
"""What touches nothing belongs to what stands nearer than this share of the room's height."""

WITHIN = 0.5
"""What has this share of its box within the box of another one of the same name is part of it, as a cushion is."""

BUILT_IN, REACHES = 0.1, 0.02
"""What shares the first part of its surface with walls, or reaches by the second part of the room beyond its sides, is
built in, and stays, unless its name is that of furniture."""

NAMING_SHARE = 0.15
"""A name counts for a thing that has this share of its area under it."""

MOST = 12
"""The most things that are proposed to move: the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """One thing that may move."""

    name: str
    pieces: Labels  # the numbers of its pieces
    low: Points  # (3,)
    high: Points  # (3,)
    emits: bool
    hangs: bool  # from the ceiling, and does not stand on the floor

    @property
    def size(self) -> Points:
        """Its extent, (3,)."""
        return self.high - self.low


def find_things(pieces: Pieces, surfaces: Surfaces, room: Room, objects: Mapping[str, str]) -> list[Thing]:
    """The things of a room, the largest first; `objects` are the objects of shape ids where the source names them."""
    cell = CELL * room.height
    names = [objects.get(shape, "") for shape in surfaces.ids]
    owner_of = {name: number for number, name in enumerate(dict.fromkeys(names))}
    owner = np.array([owner_of[name] for name in names], np.int64)[pieces.shape]
    loose = ~_is_shell(pieces, surfaces, room, names)
    group = pieces.touching(cell, loose, owner)
    if not loose.any():
        return []
    group = _joined(pieces, group, room, cell)
    group = _with_floating(pieces, group, room, cell)
    group = _of_one_name(pieces, group, surfaces, room, names)
    built_in = _built_in(pieces, group, room, cell)
    things = []
    for number in range(int(group.max()) + 1):
        thing = _thing(np.flatnonzero(group == number), pieces, surfaces, room, names)
        if thing is not None and (is_furniture(thing.name) or not built_in[number]):
            things.append(thing)
    things.sort(key=lambda thing: -float(np.prod(np.maximum(thing.size, 0.02 * room.height))))
    return _named_apart(things[:MOST])


def _is_shell(pieces: Pieces, surfaces: Surfaces, room: Room, names: list[str]) -> NDArray[np.bool_]:
    """Which pieces are the room itself, by their names, or by where they are and how large, (N,)."""
    compact = _compact(pieces, room, names)
    named = np.array([is_shell(f"{shape} {name}") for shape, name in zip(surfaces.ids, names, strict=True)])
    furniture = np.array([is_furniture(f"{shape} {name}") for shape, name in zip(surfaces.ids, names, strict=True)])
    middle, size = (pieces.low + pieces.high) / 2, pieces.high - pieces.low
    near = WALL * room.size
    outside = ((middle < room.low + near) | (middle > room.high - near))[:, :2].any(axis=1)
    outside |= pieces.low[:, 2] > room.high[2] - 1e-3 * room.height
    flat = (pieces.high[:, 2] < room.floor + FLAT * room.height) & (size[:, :2].max(axis=1) > CARPET * room.height)
    through = (pieces.low[:, 2] < room.floor + STANDS * room.height) & (size[:, 2] > TALL * room.height)
    large = (size[:, :2] > 0.8 * room.size[:2]).any(axis=1) & (size[:, 2] > 0.6 * room.height)
    whole = (size[:, :2] > 0.8 * room.size[:2]).all(axis=1)
    placed = outside | flat | large | whole | (through & ~furniture[pieces.shape])
    return named[pieces.shape] | (placed & ~compact[pieces.shape])


def _compact(pieces: Pieces, room: Room, names: list[str]) -> NDArray[np.bool_]:
    """Which shapes are of a named object that is within the room and no part of it as a whole, (S,)."""
    found = np.zeros(len(names), np.bool_)
    named = np.array(names)
    for name in set(names) - {""}:
        shapes = named == name
        own = shapes[pieces.shape]
        low, high = pieces.low[own].min(axis=0, initial=np.inf), pieces.high[own].max(axis=0, initial=-np.inf)
        middle, near = (low + high) / 2, WALL * room.size
        inside = ((middle > room.low + near) & (middle < room.high - near))[:2]
        tall = high[2] - max(low[2], room.floor) > FLAT * room.height
        found[shapes] = tall and inside.all() and ((high - low)[:2] < WIDE * room.size[:2]).all()
    return found


def _joined(pieces: Pieces, group: Labels, room: Room, cell: float) -> Labels:
    """Groups joined that touch, unless both stand for themselves, (N,)."""
    pairs, _ = pieces.contacts(cell, group)
    low, high = _bounds(pieces, group)
    stands = _stand(low, room) & ((high - low)[:, :2].max(axis=1) > SMALL * room.height)
    stands &= (high - low)[:, 2] > SMALL * room.height
    return _merged(group, pairs[~(stands[pairs[:, 0]] & stands[pairs[:, 1]])])


def _with_floating(pieces: Pieces, group: Labels, room: Room, cell: float) -> Labels:
    """Groups that touch nothing, such as a shade over its lamp, joined with the nearest that stands, (N,)."""
    low, high = _bounds(pieces, group)
    shell = len(low)
    pairs, _ = pieces.contacts(cell, np.where(group < 0, shell, group))
    held = np.zeros(shell, np.bool_)
    held[pairs[pairs[:, 1] == shell, 0]] = True
    stands = np.flatnonzero(_stand(low, room))
    floats = np.flatnonzero(~held & ~_stand(low, room))
    joined = []
    for number in floats if len(stands) else ():
        gap = np.maximum(0, np.maximum(low[stands] - high[number], low[number] - high[stands]))
        distance = np.linalg.norm(gap, axis=1)
        if distance.min() < FLOATS * room.height:
            joined.append((number, stands[int(np.argmin(distance))]))
    return _merged(group, np.array(joined, np.int64).reshape(-1, 2))


def _of_one_name(pieces: Pieces, group: Labels, surfaces: Surfaces, room: Room, names: list[str]) -> Labels:
    """Groups joined that stand, have one name, and of which one is mostly within the box of the other, (N,)."""
    low, high = _bounds(pieces, group)
    size = np.maximum(high - low, 1e-9)
    stands = np.flatnonzero(_stand(low, room))
    named = {number: _name(np.flatnonzero(group == number), pieces, surfaces, names) for number in stands}
    pairs = []
    for one, other in combinations(stands, 2):
        if named[one] == named[other]:
            shared = np.maximum(np.minimum(high[one], high[other]) - np.maximum(low[one], low[other]), 0)
            if (shared / np.minimum(size[one], size[other])).prod() > WITHIN:
                pairs.append((one, other))
    return _merged(group, np.array(pairs, np.int64).reshape(-1, 2))


def _built_in(pieces: Pieces, group: Labels, room: Room, cell: float) -> NDArray[np.bool_]:
    """Which groups share much of their surface with the room, above the floor, or reach into its walls, (T,)."""
    count, above = int(group.max()) + 1, room.floor + 2 * STANDS * room.height
    pairs, times = pieces.contacts(cell, np.where(group < 0, count, group), above)
    shared = np.zeros(count + 1)
    with_shell = pairs[:, 1] == count
    np.add.at(shared, pairs[with_shell, 0], times[with_shell])
    low, high = _bounds(pieces, group)
    reaches = ((low < room.low - REACHES * room.size) | (high > room.high + REACHES * room.size))[:, :2].any(axis=1)
    return reaches | (shared[:count] > BUILT_IN * np.maximum(pieces.cells(cell, group, count, above), 1))


def _stand(low: Points, room: Room) -> NDArray[np.bool_]:
    return low[:, 2] < room.floor + STANDS * room.height


def _merged(group: Labels, pairs: Labels) -> Labels:
    """Groups (N,) renumbered, those of a pair as one."""
    count = int(group.max()) + 1
    number = numbered(pairs, count, np.ones(count, np.bool_))
    return np.where(group >= 0, number[group], -1)


def _bounds(pieces: Pieces, group: Labels) -> tuple[Points, Points]:
    """The lower and upper corners (T, 3) of groups."""
    count, known = int(group.max()) + 1, group >= 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group[known], pieces.low[known])
    np.maximum.at(high, group[known], pieces.high[known])
    return low, high


def _thing(
    members: Labels, pieces: Pieces, surfaces: Surfaces, room: Room, names: list[str]
) -> Thing | None:  # fmt: skip
    """The thing that these pieces are; None for what should not move."""
    low, high = pieces.low[members].min(axis=0), pieces.high[members].max(axis=0)
    size, middle = high - low, (low + high) / 2
    emits = bool(surfaces.emits[pieces.shape[members]].any())
    stands = low[2] < room.floor + STANDS * room.height and low[2] > room.floor - 2 * STANDS * room.height
    hangs = room.has_ceiling and high[2] > room.high[2] - STANDS * room.height and not stands
    inside = ((middle > room.low) & (middle < room.high)).all()
    large = (size[:2] > WIDE * room.size[:2]).any() or size[2] > TALL * room.height
    small = np.sort(size)[1] < SMALL * room.height or size.min() < SHEET * room.height
    if not inside or large or small or not (stands or (hangs and emits)):
        return None
    return Thing(_name(members, pieces, surfaces, names), members, low, high, emits, bool(hangs))


def _name(members: Labels, pieces: Pieces, surfaces: Surfaces, names: list[str]) -> str:
    """The object or shape that has most of its area; names of furniture before others."""
    area: dict[str, float] = {}
    for piece in members:
        shape = pieces.shape[piece]
        name = names[shape] or surfaces.ids[shape]
        area[name] = area.get(name, 0.0) + float(pieces.area[piece])
    ordered = sorted(area, key=lambda name: -area[name])
    counting = [name for name in ordered if area[name] > NAMING_SHARE * sum(area.values())]
    return group_name(next((name for name in counting if is_furniture(name)), ordered[0]))


def _named_apart(things: list[Thing]) -> list[Thing]:
    """The same with distinct names."""
    taken: Counter[str] = Counter()
    made = []
    for thing in things:
        taken[thing.name] += 1
        number = taken[thing.name]
        made.append(thing if number == 1 else replace(thing, name=f"{thing.name}-{number}"))
    return made


def faces_of(thing: Thing, pieces: Pieces) -> NDArray[Any]:
    """Which faces are of a thing, (F,)."""
    return np.isin(pieces.label, thing.pieces)
