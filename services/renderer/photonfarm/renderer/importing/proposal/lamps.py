"""Lamps: which of them may move along the ceiling, and why others stay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.proposal.room import Room
from photonfarm.renderer.importing.proposal.surfaces import Points

HUGE = 1 / 3
"""A light of this share of the ceiling is the ceiling."""

PLANE, CLOSED = 0.01, 0.75
"""What is within this share of the room's height of the ceiling lies in its plane. The ceiling is closed over a lamp
where the second share of the cells over it have a point of that plane."""

AT_CEILING, APART = 0.04, 0.08
"""What reaches this share of the room's height below the ceiling hangs from it; what is in the upper half and farther
than the second share from all that stays, too, on a wire that is not modelled."""

SHEET = 0.01
"""What is thinner than this share of the room's height is a sheet."""

MOVES = ""
IN_WALL = "in a wall or window"
IN_CEILING = "set into the ceiling, which has a hole there"
LARGE = "as large as the room or its ceiling"
HELD = "on or in something that stays, or in the air"
MANY = "as only the largest are proposed to move"
OUTSIDE = "as nothing is proposed to move where there is no room"


def why_fixed(low: Points, high: Points, room: Room, outside: NDArray[np.bool_]) -> NDArray[Any]:
    """Why lights with these corners (N, 3) stay wherever they hang, or MOVES, (N,); `outside`: in a wall or beyond."""
    size = high - low
    wide = (size[:, :2].prod(axis=1) > HUGE * room.size[:2].prod()) & (size[:, 2] < 0.5 * room.height)
    above = (high[:, 2] > room.high[2] + PLANE * room.height) & room.has_ceiling
    return np.select([wide, outside, above], [LARGE, IN_WALL, IN_CEILING], MOVES).astype(object)


def hangs(low: Points, high: Points, room: Room, others: Points) -> bool:
    """Whether a lamp hangs from the ceiling, by the corners (3,) around it and the points (M, 3) on all else."""
    if not room.has_ceiling or high[2] > room.high[2] - AT_CEILING * room.height:
        return room.has_ceiling
    apart = APART * room.height
    near = ((others > low - apart) & (others < high + apart)).all(axis=1)
    return bool(low[2] > room.floor + 0.5 * room.height and not near.any())


def why_it_stays(low: Points, high: Points, room: Room, flat: float, others: Points, cell: float) -> str:
    """Why a lamp that hangs stays, or MOVES; `flat` is the share of its light that shines up or down."""
    size, tall = high - low, SHEET * room.height
    if flat < 0.5 and size[:2].min() < tall < size[2]:
        return IN_WALL
    if high[2] < room.high[2] - AT_CEILING * room.height:
        return MOVES
    side = max(float(size[:2].max()) / 8, 2 * cell)
    count = np.maximum(np.round(size[:2] / side), 1).astype(int)
    plane = others[np.abs(others[:, 2] - room.high[2]) < PLANE * room.height, :2]
    place = np.floor((plane - low[:2]) / np.maximum(size[:2], 1e-30) * count).astype(int)
    place = place[((place >= 0) & (place < count)).all(axis=1)]
    return MOVES if len(np.unique(place, axis=0)) >= CLOSED * count.prod() else IN_CEILING
