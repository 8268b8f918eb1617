"""What stands or hangs in a room as one thing, and what is the room itself. Letters: N pieces, S shapes, T groups."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count as numbers_from
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.tools.importing.proposal.room import Room
from photonfarm.renderer.tools.importing.proposal.surfaces import (
    Labels,
    Pieces,
    Points,
    Surfaces,
    bounds,
    number_components,
)

# Shares of the room's height, where nothing else is said.
CELL = 1 / 150  # surfaces touch up to this distance: 1.8 cm in a room of 2.7 m
FLAT, CARPET = 0.03, 0.25  # what rises less than the first one and is longer than the second one is a carpet, and stays
STANDS = 0.04  # what begins below this height stands on the floor
FLOATS = 0.08  # what touches nothing belongs to what stands or hangs nearer than this
SMALL, SLENDER = 0.1, 0.03  # what is shorter in two directions stands for nothing by itself; of lamps
SHEET = 0.01  # what is thinner is a sheet
PLANE = 0.01  # what is nearer to the ceiling lies in its plane
AT_CEILING = 0.04  # what reaches up to this distance from the ceiling hangs from it
WALL = 0.03  # of the room: what has its middle within this of a side, or beyond it, is part of the wall
BEHIND = 0.1  # of the room: what is as far behind its sides is outside, and not in a window
TALL, WIDE = 0.88, 0.6  # of the room: what is taller or wider is part of it
HUGE = 1 / 3  # of the ceiling: a light as large is the ceiling
CLOSED = 0.75  # of the places over a lamp: the ceiling is closed there if as many have a point of its plane
BUILT_IN = 0.1  # of its surface: what shares as much with walls is built in, unless it has a name of furniture
REACHES = 0.02  # of the room: so is what reaches as far beyond its sides
NAMING_SHARE = 0.15  # of its area: a name counts for a thing that has as much under it

BUILDING = 5.0
"""Outdoors, what is longer than this, in the file's units, stays: it is a house rather than furniture."""

MOST = 12
"""The most things, and the most lights, that are proposed to move: the largest."""

_SHELL = re.compile(
    "wall|floor|ceil|window|door|skirting|baseboard|curtain|drape|blind|roof|ground|beam|column|pillar|stair|radiator|"
    "carpet|rug|(?<!mush)room|shell|pane|sill|moulding|molding|socket|switch"
)

_FURNITURE = re.compile(
    "sofa|couch|chair|table|lamp|plant|bed|cabinet|desk|shelf|bookcase|wardrobe|stool|bench|tv|television|speaker|vase|"
    "pot|ottoman|piano|basket|ball|bear|dresser|drawer|fridge|pouf|cactus|bottle|bowl|cushion"
)

MOVES = ""
IN_WALL = "in a wall or window"
IN_CEILING = "set into the ceiling, which has a hole there"
LARGE = "as large as the room or its ceiling"
HELD = "on or in something that stays, or in the air"
AT_LIGHT = "around or beside a light that has no shape"
MANY = "as only the largest are proposed to move"
OUTSIDE = "outside the room"
NO_ROOM = "as nothing is proposed to move where there is no room"


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
    def at(self) -> Points:
        """The middle (3,) of its lower side; of what hangs, of its upper side."""
        x, y, _ = (self.low + self.high) / 2
        return np.array([x, y, (self.high if self.hangs else self.low)[2]])

    @property
    def size(self) -> Points:
        """Its extent, (3,)."""
        return self.high - self.low


class Found(NamedTuple):
    """A room, and what was found in it."""

    room: Room
    pieces: Pieces
    things: list[Thing]  # the largest first
    stays: dict[str, list[str]]  # the names of lights that stay, and of what stays with one, by the reason

    @property
    def moving(self) -> set[int]:
        """The numbers of the pieces that may move."""
        return {int(piece) for thing in self.things for piece in thing.pieces}


def find_things(surfaces: Surfaces, room: Room, objects: Mapping[str, str]) -> Found:
    """What may move in a room; `objects` are the objects of shape ids where the source names them."""
    pieces = Pieces.of(surfaces, CELL * room.height, float(room.size.max()))
    return _Search(pieces, surfaces, room, [objects.get(shape, "") for shape in surfaces.ids]).find()


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    pieces: Pieces
    surfaces: Surfaces
    room: Room
    names: list[str]  # (S,) of objects

    def find(self) -> Found:
        pieces, glows = self.pieces, self.surfaces.emits[self.pieces.shape]
        why = np.where(glows, self._why_fixed(), MOVES)
        loose = np.where(glows, why == MOVES, ~self._is_shell()) & (not self.room.is_stage)
        group = self._group(loose, glows)
        things, lit = [], self._near_lights(group)
        for number, built_in in enumerate(self._find_built_in(group)):
            thing = self._thing(np.flatnonzero(group == number), bool(built_in))
            if isinstance(thing, Thing) and not lit[number]:
                things.append(thing)
            else:
                why[group == number] = AT_LIGHT if isinstance(thing, Thing) else thing
        things.sort(key=self._order)
        kept = [thing for emits in (False, True) for thing in [t for t in things if t.emits == emits][:MOST]]
        for thing in things:
            if thing not in kept:
                why[thing.pieces] = MANY
        stays: dict[str, list[str]] = {}
        told = np.flatnonzero(glows | (why == AT_LIGHT))
        for name, reason in {self._name_of(pieces.shape[one]): why[one] for one in told}.items():
            if reason != MOVES:
                stays.setdefault(str(reason), []).append(name)
        return Found(self.room, pieces, _name_apart(kept), stays)

    def _in_walls(self, gap: float) -> NDArray[np.bool_]:
        """Which pieces have their middle close to a wall or beyond it, and are no farther from it than a gap, (N,)."""
        pieces, room = self.pieces, self.room
        middle, near = (pieces.low + pieces.high) / 2, WALL * room.size
        inner = (middle < room.low + near) & (pieces.low < room.low + gap)
        outer = (middle > room.high - near) & (pieces.high > room.high - gap)
        return np.asarray((inner | outer)[:, :2].any(axis=1))

    def _why_fixed(self) -> NDArray[Any]:
        """Why each piece would stay as a light wherever it hangs, or MOVES, (N,)."""
        pieces, room = self.pieces, self.room
        size = pieces.high - pieces.low
        wide = (size[:, :2].prod(axis=1) > HUGE * room.size[:2].prod()) & (size[:, 2] < 0.5 * room.height)
        above = (pieces.high[:, 2] > room.high[2] + PLANE * room.height) & room.has_ceiling
        apart = np.maximum(pieces.low - room.high, room.low - pieces.high) > BEHIND * room.size
        cases = {
            LARGE: wide,
            OUTSIDE: apart[:, :2].any(axis=1),
            IN_WALL: self._in_walls(np.inf),
            IN_CEILING: above,
        }
        if room.is_stage:
            cases = {NO_ROOM: np.ones(len(size), np.bool_)}
        return np.select([*cases.values()], [*cases], MOVES).astype(object)

    def _order(self, thing: Thing) -> tuple[float, int]:
        """The order by volume, to three digits, so that things that are alike keep the file's order."""
        volume = np.maximum(thing.size, 0.02 * self.room.height).prod()
        return -float(f"{volume:.3g}"), int(self.pieces.shape[thing.pieces].min())

    def _name_of(self, shape: int) -> str:
        return self.names[shape] or self.surfaces.ids[shape]

    def _is_shell(self) -> NDArray[np.bool_]:
        """Which pieces are the room itself, by their names, or by where they are and how large, (N,)."""
        pieces, room = self.pieces, self.room
        called = [f"{shape} {name}" for shape, name in zip(self.surfaces.ids, self.names, strict=True)]
        named = np.array([*map(is_shell, called)])[pieces.shape]
        size = pieces.high - pieces.low
        above = pieces.low[:, 2] > room.high[2] - 1e-3 * room.height
        flat = (pieces.high[:, 2] < room.floor + FLAT * room.height) & (size[:, :2].max(axis=1) > CARPET * room.height)
        wide = size[:, :2] > 0.8 * room.size[:2]
        large = (wide.any(axis=1) & (size[:, 2] > 0.6 * room.height)) | wide.all(axis=1)
        walls = self._in_walls(CELL * room.height)
        shell = named | ((walls | above | flat | large) & ~self._compact())
        return self._without_backs(shell, np.flatnonzero(shell & walls & ~(named | above | flat | large)))

    def _without_backs(self, shell: NDArray[np.bool_], near: Labels) -> NDArray[np.bool_]:
        """The shell (N,) less those of the pieces `near` walls that touch more of what is loose than of the shell.

        Such is the back of an armchair before a bay window, where the wall's plane is not the wall.
        """
        group = np.where(shell, -1, 0)
        group[near] = 1 + np.arange(len(near))
        cells = self.pieces.contacts(CELL * self.room.height, group)[1:-1]
        mended = shell.copy()
        mended[near] = cells[:, [0]].toarray().ravel() <= cells[:, [-1]].toarray().ravel()
        return mended

    def _compact(self) -> NDArray[np.bool_]:
        """Which pieces are of a named object that is within the room and no part of it as a whole, (N,)."""
        pieces, room, owner = self.pieces, self.room, self._owner()
        low, high = bounds(owner, int(owner.max()) + 1, pieces.low, pieces.high)
        middle, near = (low + high) / 2, WALL * room.size
        inside = ((middle > room.low + near) & (middle < room.high - near))[:, :2].all(axis=1)
        tall = high[:, 2] - np.maximum(low[:, 2], room.floor) > FLAT * room.height
        small = ((high - low)[:, :2] < WIDE * room.size[:2]).all(axis=1)
        return (np.array(self.names)[pieces.shape] != "") & (inside & tall & small)[owner]

    def _owner(self) -> Labels:
        """The number of each piece's object, (N,)."""
        return np.unique(self.names, return_inverse=True)[1][self.pieces.shape]

    def _group(self, loose: NDArray[np.bool_], glows: NDArray[np.bool_]) -> Labels:
        """The groups of loose pieces, −1 for others, (N,)."""
        group = self.pieces.touching(CELL * self.room.height, loose, self._owner())
        group = _merge(group, self._touching(group))
        return _merge(group, self._floating(group, glows))

    def _touching(self, group: Labels) -> Labels:
        """Pairs of groups that touch, unless both stand for themselves."""
        low, high = self._bounds(group)
        size, cells = high - low, self.pieces.contacts(CELL * self.room.height, group)
        pairs = np.column_stack(cells[:-1, :-1].nonzero())
        stands = self._stand(low) & (np.minimum(size[:, :2].max(axis=1), size[:, 2]) > SMALL * self.room.height)
        return pairs[~(stands[pairs[:, 0]] & stands[pairs[:, 1]])]

    def _floating(self, group: Labels, glows: NDArray[np.bool_]) -> Labels:
        """Pairs of what touches nothing, such as a shade over its lamp, and the nearest that stands or hangs."""
        room, (low, high) = self.room, self._bounds(group)
        held = self.pieces.contacts(CELL * room.height, group)[:-1, [-1]].toarray().ravel() > 0
        shines = np.zeros(len(low), np.bool_)
        shines[group[glows & (group >= 0)]] = True
        stands, upper = self._stand(low), low[:, 2] > room.floor + 0.5 * room.height
        ends = np.flatnonzero(stands | (upper & shines) | (held & (high[:, 2] > room.high[2] - STANDS * room.height)))
        joined = []
        for number in np.flatnonzero(~held & ~stands):
            others = ends[ends != number]
            distance = _distance(low[others], high[others], low[number], high[number])
            if distance.min(initial=np.inf) < FLOATS * room.height:
                joined.append((number, others[int(np.argmin(distance))]))
        return np.array(joined, np.int64).reshape(-1, 2)

    def _near_lights(self, group: Labels) -> NDArray[np.bool_]:
        """Which groups are around a light without a shape or, where none is, nearest to it and near, (T,)."""
        light = self.surfaces.lights[:, None]
        distance = _distance(*self._bounds(group), light, light)
        nearest = distance.min(axis=1, initial=FLOATS * self.room.height, keepdims=True)
        return np.asarray((distance <= nearest).any(axis=0))

    def _find_built_in(self, group: Labels) -> NDArray[np.bool_]:
        """Which groups share much of their surface with the room, above the floor, or reach into its walls, (T,)."""
        room, (low, high) = self.room, self._bounds(group)
        cells = self.pieces.contacts(CELL * room.height, group, room.floor + 2 * STANDS * room.height)
        reach = REACHES * room.size
        reaches = ((low < room.low - reach) | (high > room.high + reach))[:, :2].any(axis=1)
        shared = cells[:-1, [-1]].toarray().ravel()
        return reaches | (shared > BUILT_IN * np.maximum(cells.diagonal()[:-1], 1))

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
        hangs = is_lamp and self._hangs(low, high, others)
        inside = (middle > room.low) & (middle < room.high + PLANE * room.size * [0, 0, hangs])
        if not inside.all():
            return IN_WALL if inside[2] else HELD
        wide = size[:2] > WIDE * room.size[:2]
        if (wide.all() if hangs else wide.any()) or size[2] > TALL * room.height:
            return LARGE
        if hangs:
            flat = float(np.average(pieces.flat[glow], weights=np.maximum(pieces.area[glow], 1e-30)))
            reason = self._why_it_stays(low, high, flat, others)
            return reason or Thing(name, members, low, high, emits=True, hangs=True)
        least = (SLENDER if len(glow) else SMALL) * room.height
        building = room.subject is not None and size.max() > BUILDING
        if not stands or np.sort(size)[1] < least or building or (built_in and not is_furniture(name)):
            return HELD
        if size.min() < SHEET * room.height:
            return IN_WALL
        return Thing(name, members, low, high, bool(len(glow)), hangs=False)

    def _hangs(self, low: Points, high: Points, others: Points) -> bool:
        """Whether a lamp hangs from the ceiling, by the corners (3,) around it and the points (M, 3) on all else.

        It does in the upper half, too, where nothing is near: on a wire that is not modelled.
        """
        room, apart = self.room, FLOATS * self.room.height
        if not room.has_ceiling or high[2] > room.high[2] - AT_CEILING * room.height:
            return room.has_ceiling
        near = ((others > low - apart) & (others < high + apart)).all(axis=1)
        return bool(low[2] > room.floor + 0.5 * room.height and not near.any())

    def _why_it_stays(self, low: Points, high: Points, flat: float, others: Points) -> str:
        """Why a lamp that hangs stays, or MOVES; `flat` is the share of its light that shines up or down."""
        room, size = self.room, high - low
        if flat < 0.5 and size[:2].min() < SHEET * room.height < size[2]:
            return IN_WALL
        if high[2] < room.high[2] - AT_CEILING * room.height:
            return MOVES
        side = max(float(size[:2].max()) / 8, 2 * CELL * room.height)
        count = np.maximum(np.round(size[:2] / side), 1).astype(int)
        plane = others[np.abs(others[:, 2] - room.high[2]) < PLANE * room.height, :2]
        place = np.floor((plane - low[:2]) / np.maximum(size[:2], 1e-30) * count).astype(int)
        place = place[((place >= 0) & (place < count)).all(axis=1)]
        return MOVES if len(np.unique(place, axis=0)) >= CLOSED * count.prod() else IN_CEILING

    def _name(self, members: Labels) -> str:
        """The object or shape that has most of its area; names of furniture before others, and then of lamps."""
        area: dict[str, float] = {}
        for piece in members:
            name = self._name_of(self.pieces.shape[piece])
            area[name] = area.get(name, 0.0) + float(self.pieces.area[piece])
        ordered = sorted(area, key=lambda name: -area[name])
        counting = [name for name in ordered if area[name] > NAMING_SHARE * sum(area.values())]
        shining = {self._name_of(shape) for shape in self.pieces.shape[members] if self.surfaces.emits[shape]}
        wishes = [name for name in counting if is_furniture(name)] + [name for name in ordered if name in shining]
        return group_name([*wishes, ordered[0]][0])


def _distance(low: Points, high: Points, from_low: Points, from_high: Points) -> NDArray[np.float64]:
    """The distances of boxes from others, by their corners (…, 3); 0 where they meet."""
    gap = np.maximum(0, np.maximum(low - from_high, from_low - high))
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _merge(group: Labels, pairs: Labels) -> Labels:
    """Groups (N,) renumbered, those of a pair as one."""
    count = int(group.max(initial=-1)) + 1
    number = number_components(pairs, count, np.ones(count, np.bool_)) if count else group
    return np.where(group >= 0, number[group], -1)


def _name_apart(things: list[Thing]) -> list[Thing]:
    """The same with distinct names."""
    own, taken, made = {thing.name for thing in things}, {"ceiling-light"}, []
    for thing in things:
        others = (f"{thing.name}-{number}" for number in numbers_from(2))
        name = thing.name if thing.name not in taken else next(n for n in others if n not in taken | own)
        taken.add(name)
        made.append(replace(thing, name=name))
    return made


def is_shell(name: str) -> bool:
    """Whether a name is of the room itself, such as a wall, and of nothing that stands in it."""
    return _SHELL.search(name.lower()) is not None and not is_furniture(name)


def is_furniture(name: str) -> bool:
    """Whether a name is of a piece of furniture."""
    return _FURNITURE.search(name.lower()) is not None


def group_name(name: str) -> str:
    """A name as it is, as far as a spec allows it: without accents, and with hyphens for other signs."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", plain).strip("-_.")[:60] or "object"
