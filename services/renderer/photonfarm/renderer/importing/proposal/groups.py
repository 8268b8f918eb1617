"""What stands or hangs in a room as one thing, and what is the room itself. Letters: N pieces, S shapes, T groups."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from itertools import count as numbers_from
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.proposal import lamps
from photonfarm.renderer.importing.proposal.names import group_name, is_furniture, is_shell, stem
from photonfarm.renderer.importing.proposal.pieces import Labels, Pieces, numbered
from photonfarm.renderer.importing.proposal.room import Room
from photonfarm.renderer.importing.proposal.surfaces import Points, Surfaces, bounds

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

SMALL, SLENDER = 0.1, 0.03
"""What is shorter than this share of the room's height in two directions stands for nothing by itself; of lamps."""

FLOATS = 0.08
"""What touches nothing belongs to what stands nearer than this share of the room's height."""

WITHIN = 0.5
"""What has this share of its box within the box of another one of the same name is part of it, as a cushion is."""

BUILT_IN, REACHES = 0.1, 0.02
"""What shares the first part of its surface with walls, or reaches by the second part of the room beyond its sides, is
built in, and stays, unless its name is that of furniture."""

NAMING_SHARE = 0.15
"""A name counts for a thing that has this share of its area under it."""

BUILDING = 5.0
"""Outdoors, what is longer than this, in the file's units, stays: it is a house rather than furniture."""

MOST = 12
"""The most things, and the most lights, that are proposed to move: the largest."""


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


class Found(NamedTuple):
    """What was found in a room."""

    things: list[Thing]  # the largest first
    stays: dict[str, list[str]]  # the names of lights that stay, by the reason


def find_things(pieces: Pieces, surfaces: Surfaces, room: Room, objects: Mapping[str, str]) -> Found:
    """What may move in a room; `objects` are the objects of shape ids where the source names them."""
    return _Search(pieces, surfaces, room, [objects.get(shape, "") for shape in surfaces.ids]).find()


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    pieces: Pieces
    surfaces: Surfaces
    room: Room
    names: list[str]  # (S,) of objects

    def find(self) -> Found:
        pieces, glows = self.pieces, self.surfaces.emits[self.pieces.shape]
        middle, near = (pieces.low + pieces.high) / 2, WALL * self.room.size
        beyond = (middle < self.room.low + near) | (middle > self.room.high - near)
        outside: NDArray[np.bool_] = beyond[:, 0] | beyond[:, 1]
        why = np.where(glows, lamps.why_fixed(pieces.low, pieces.high, self.room, outside), lamps.MOVES)
        loose = np.where(glows, why == lamps.MOVES, ~self._is_shell(outside))
        group = self._grouped(loose, glows)
        things = []
        for number, built_in in enumerate(self._built_in(group)):
            thing = self._thing(np.flatnonzero(group == number), bool(built_in))
            if isinstance(thing, Thing):
                things.append(thing)
            else:
                why[group == number] = thing
        things.sort(key=lambda thing: (-self._volume(thing), pieces.shape[thing.pieces].min()))
        kept = [thing for emits in (False, True) for thing in [t for t in things if t.emits == emits][:MOST]]
        for thing in things:
            if thing not in kept:
                why[thing.pieces] = lamps.MANY
        stays: dict[str, list[str]] = {}
        for name, reason in {self._called(pieces.shape[one]): why[one] for one in np.flatnonzero(glows)}.items():
            if reason != lamps.MOVES:
                stays.setdefault(str(reason), []).append(name)
        return Found(_named_apart(kept), stays)

    def _volume(self, thing: Thing) -> float:
        """Its volume to three digits, so that things that are alike keep the file's order."""
        return float(f"{np.prod(np.maximum(thing.size, 0.02 * self.room.height)):.3g}")

    def _called(self, shape: int) -> str:
        return self.names[shape] or self.surfaces.ids[shape]

    def _is_shell(self, outside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which pieces are the room itself, by their names, or by where they are and how large, (N,)."""
        pieces, room = self.pieces, self.room
        called = [f"{shape} {name}" for shape, name in zip(self.surfaces.ids, self.names, strict=True)]
        named, furniture = (np.array([*map(says, called)])[pieces.shape] for says in (is_shell, is_furniture))
        size = pieces.high - pieces.low
        above = pieces.low[:, 2] > room.high[2] - 1e-3 * room.height
        flat = (pieces.high[:, 2] < room.floor + FLAT * room.height) & (size[:, :2].max(axis=1) > CARPET * room.height)
        through = self._stand(pieces.low) & (size[:, 2] > TALL * room.height)
        wide = size[:, :2] > 0.8 * room.size[:2]
        large = (wide.any(axis=1) & (size[:, 2] > 0.6 * room.height)) | wide.all(axis=1)
        return named | ((outside | above | flat | large | (through & ~furniture)) & ~self._compact()[pieces.shape])

    def _compact(self) -> NDArray[np.bool_]:
        """Which shapes are of a named object that is within the room and no part of it as a whole, (S,)."""
        pieces, room, named = self.pieces, self.room, np.array(self.names)
        found = np.zeros(len(named), np.bool_)
        for name in set(self.names) - {""}:
            own = (named == name)[pieces.shape]
            low, high = pieces.low[own].min(axis=0, initial=np.inf), pieces.high[own].max(axis=0, initial=-np.inf)
            middle, near = (low + high) / 2, WALL * room.size
            inside = ((middle > room.low + near) & (middle < room.high - near))[:2]
            tall = high[2] - max(low[2], room.floor) > FLAT * room.height
            found[named == name] = tall and inside.all() and ((high - low)[:2] < WIDE * room.size[:2]).all()
        return found

    def _grouped(self, loose: NDArray[np.bool_], glows: NDArray[np.bool_]) -> Labels:
        """The groups of loose pieces, −1 for others, (N,)."""
        owner_of = {name: number for number, name in enumerate(dict.fromkeys(self.names))}
        owner = np.array([owner_of[name] for name in self.names], np.int64)[self.pieces.shape]
        group = self.pieces.touching(CELL * self.room.height, loose, owner)
        for join in (self._touching, lambda group: self._floating(group, glows), self._of_one_name):
            group = _merged(group, join(group))
        return group

    def _touching(self, group: Labels) -> Labels:
        """Pairs of groups that touch, unless both stand for themselves."""
        pairs, _, _ = self.pieces.contacts(CELL * self.room.height, group)
        low, high = self._bounds(group)
        size = high - low
        stands = self._stand(low) & (np.minimum(size[:, :2].max(axis=1), size[:, 2]) > SMALL * self.room.height)
        return pairs[~(stands[pairs[:, 0]] & stands[pairs[:, 1]])]

    def _floating(self, group: Labels, glows: NDArray[np.bool_]) -> Labels:
        """Pairs of what touches nothing, such as a shade over its lamp, and the nearest that stands or hangs."""
        room, (low, high) = self.room, self._bounds(group)
        shell = len(low)
        pairs, _, _ = self.pieces.contacts(CELL * room.height, np.where(group < 0, shell, group))
        held, shines = np.zeros(shell, np.bool_), np.zeros(shell, np.bool_)
        held[pairs[pairs[:, 1] == shell, 0]] = True
        shines[group[glows & (group >= 0)]] = True
        stands, upper = self._stand(low), low[:, 2] > room.floor + 0.5 * room.height
        ends = np.flatnonzero(stands | (upper & shines) | (held & (high[:, 2] > room.high[2] - STANDS * room.height)))
        joined = []
        for number in np.flatnonzero(~held & ~stands):
            others = ends[ends != number]
            gap = np.maximum(0, np.maximum(low[others] - high[number], low[number] - high[others]))
            distance = np.linalg.norm(gap, axis=1)
            if distance.min(initial=np.inf) < FLOATS * room.height:
                joined.append((number, others[int(np.argmin(distance))]))
        return np.array(joined, np.int64).reshape(-1, 2)

    def _of_one_name(self, group: Labels) -> Labels:
        """Pairs of groups that stand, have one name, and of which one is mostly within the box of the other."""
        low, high = self._bounds(group)
        size, stands = np.maximum(high - low, 1e-9), np.flatnonzero(self._stand(low))
        named = {number: stem(self._name(np.flatnonzero(group == number))) for number in stands}
        pairs = []
        for one, other in combinations(stands, 2):
            if named[one] == named[other]:
                shared = np.maximum(np.minimum(high[one], high[other]) - np.maximum(low[one], low[other]), 0)
                if (shared / np.minimum(size[one], size[other])).prod() > WITHIN:
                    pairs.append((one, other))
        return np.array(pairs, np.int64).reshape(-1, 2)

    def _built_in(self, group: Labels) -> NDArray[np.bool_]:
        """Which groups share much of their surface with the room, above the floor, or reach into its walls, (T,)."""
        room, (low, high) = self.room, self._bounds(group)
        count, above = len(low), room.floor + 2 * STANDS * room.height
        pairs, times, cells = self.pieces.contacts(CELL * room.height, np.where(group < 0, count, group), above)
        with_shell = pairs[:, 1] == count
        shared = np.bincount(pairs[with_shell, 0], times[with_shell], count)[:count]
        reach = REACHES * room.size
        reaches = ((low < room.low - reach) | (high > room.high + reach))[:, :2].any(axis=1)
        return reaches | (shared > BUILT_IN * np.maximum(np.bincount(cells, minlength=count)[:count], 1))

    def _stand(self, low: Points) -> NDArray[np.bool_]:
        return low[..., 2] < self.room.floor + STANDS * self.room.height

    def _bounds(self, group: Labels) -> tuple[Points, Points]:
        """The lower and upper corners (T, 3) of groups."""
        known = group >= 0
        return bounds(group[known], int(group.max(initial=-1)) + 1, self.pieces.low[known], self.pieces.high[known])

    def _thing(self, members: Labels, built_in: bool) -> Thing | str:
        """The thing that these pieces are, or why they should not move."""
        pieces, room, name = self.pieces, self.room, self._name(members)
        low, high = pieces.low[members].min(axis=0), pieces.high[members].max(axis=0)
        size, middle = high - low, (low + high) / 2
        glow = members[self.surfaces.emits[pieces.shape[members]]]
        stands = bool(self._stand(low)) and low[2] > room.floor - 2 * STANDS * room.height
        is_lamp = bool(len(glow)) and not stands
        others = pieces.sample[~np.isin(pieces.sample_piece, members)] if is_lamp else pieces.sample[:0]
        hangs = is_lamp and lamps.hangs(low, high, room, others)
        top = room.high + lamps.PLANE * room.size * [0, 0, hangs]
        if not ((middle > room.low) & (middle < top)).all():
            return lamps.IN_WALL
        if (size[:2] > WIDE * room.size[:2]).any() or size[2] > TALL * room.height:
            return lamps.LARGE
        if hangs:
            flat = float(np.average(pieces.flat[glow], weights=np.maximum(pieces.area[glow], 1e-30)))
            reason = lamps.why_it_stays(low, high, room, flat, others, CELL * room.height)
            return reason or Thing(name, members, low, high, emits=True, hangs=True)
        least = (SLENDER if len(glow) else SMALL) * room.height
        building = room.subject is not None and size.max() > BUILDING
        if not stands or np.sort(size)[1] < least or building or (built_in and not is_furniture(name)):
            return lamps.HELD
        if size.min() < lamps.SHEET * room.height:
            return lamps.IN_WALL
        return Thing(name, members, low, high, bool(len(glow)), hangs=False)

    def _name(self, members: Labels) -> str:
        """The object or shape that has most of its area; names of furniture before others, and then of lamps."""
        area: dict[str, float] = {}
        for piece in members:
            name = self._called(self.pieces.shape[piece])
            area[name] = area.get(name, 0.0) + float(self.pieces.area[piece])
        ordered = sorted(area, key=lambda name: -area[name])
        counting = [name for name in ordered if area[name] > NAMING_SHARE * sum(area.values())]
        shining = {self._called(shape) for shape in self.pieces.shape[members] if self.surfaces.emits[shape]}
        wishes = [name for name in counting if is_furniture(name)] + [name for name in ordered if name in shining]
        return group_name([*wishes, ordered[0]][0])


def _merged(group: Labels, pairs: Labels) -> Labels:
    """Groups (N,) renumbered, those of a pair as one."""
    count = int(group.max(initial=-1)) + 1
    number = numbered(pairs, count, np.ones(count, np.bool_)) if count else group
    return np.where(group >= 0, number[group], -1)


def _named_apart(things: list[Thing]) -> list[Thing]:
    """The same with distinct names."""
    own, taken, made = {thing.name for thing in things}, {"ceiling-light"}, []
    for thing in things:
        others = (f"{thing.name}-{number}" for number in numbers_from(2))
        name = thing.name if thing.name not in taken else next(n for n in others if n not in taken | own)
        taken.add(name)
        made.append(replace(thing, name=name))
    return made
