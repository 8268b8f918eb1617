"""A room seen from above, as a grid: where there is floor, and where something stands in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photonfarm.renderer.importing.proposal.pieces import Pieces
from photonfarm.renderer.importing.proposal.room import Room
from photonfarm.renderer.importing.proposal.surfaces import Points

CELLS = 96
"""Cells along the longer side of the room."""

Mask = NDArray[np.bool_]

NEAR_FLOOR = 0.03
"""Flat surfaces within this share of the room's height are the floor, or lie on it."""


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """The grid, and the points on everything that does not move."""

    low: Points  # (2,)
    cell: float
    shape: tuple[int, int]
    fixed: Points  # (M, 3)
    floor: Mask  # (A, B)

    @classmethod
    def of(cls, pieces: Pieces, room: Room, fixed_pieces: NDArray[np.bool_]) -> Self:
        """The plan of a room; `fixed_pieces` (N,) are those that do not move."""
        cell = float(room.size[:2].max()) / CELLS
        shape = tuple(int(n) for n in np.maximum(np.ceil(room.size[:2] / cell), 1))
        chosen = fixed_pieces[pieces.sample_piece]
        fixed = pieces.sample[chosen]
        near = np.abs(fixed[:, 2] - room.floor) < NEAR_FLOOR * room.height
        plan = cls(room.low[:2].copy(), cell, (shape[0], shape[1]), fixed, np.zeros(shape, np.bool_))
        floor = plan._marked(fixed[near & pieces.sample_flat[chosen]])
        closed = ndimage.binary_closing(floor, iterations=2, border_value=0) | floor
        return cls(plan.low, cell, plan.shape, fixed, closed)

    def _marked(self, points: Points) -> Mask:
        place = np.floor((points[:, :2] - self.low) / self.cell).astype(np.int64)
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        mask: Mask = np.zeros(self.shape, np.bool_)
        mask[tuple(place[inside].T)] = True
        return mask

    def free(self, bottom: float, top: float, half: Points) -> Mask:
        """Where the middle of a box of half-lengths `half` (2,) may be: over floor, and with nothing in its way."""
        height = self.fixed[:, 2]
        blocked = self._marked(self.fixed[(height > bottom) & (height < top)])
        reach = np.ceil(half / self.cell).astype(int)
        blocked = ndimage.maximum_filter(blocked, size=tuple(2 * reach + 1), mode="constant", cval=1)
        floor = self.floor if self.floor.mean() > 0.05 else np.ones_like(self.floor)
        free: Mask = ~blocked & floor
        return free

    def box_around(self, free: Mask, point: Points, reach: Points) -> tuple[Points, Points] | None:
        """The largest free rectangle around the free place nearest to a point, up to `reach` (2,) from it.

        Its corners (2,), which are middles of cells; None if no free place is within reach.
        """
        middles = [self.low[i] + (np.arange(self.shape[i]) + 0.5) * self.cell for i in (0, 1)]
        near = free & np.logical_and.outer(*(np.abs(middles[i] - point[i]) <= reach[i] for i in (0, 1)))
        if not near.any():
            return None
        places = np.argwhere(near)
        away = [np.hypot(middles[0][a] - point[0], middles[1][b] - point[1]) for a, b in places]
        first, last = largest_rectangle(near, *places[int(np.argmin(away))])
        corners = np.array([[middles[i][first[i]], middles[i][last[i]]] for i in (0, 1)])
        return corners[:, 0], corners[:, 1]

    def places(self, height: float) -> Points:
        """The middles of all cells at a height, (A · B, 3)."""
        a, b = np.meshgrid(*(self.low[i] + (np.arange(self.shape[i]) + 0.5) * self.cell for i in (0, 1)), indexing="ij")
        return np.stack([a, b, np.full_like(a, height)], axis=-1).reshape(-1, 3)

    def widest_place(self, free: Mask) -> Points:
        """The point (2,) that is farthest from whatever is not free."""
        depth = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
        place = np.array(np.unravel_index(int(np.argmax(depth)), free.shape))
        made: Points = self.low + (place + 0.5) * self.cell
        return made


def largest_rectangle(free: Mask, row: int, column: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The first and last cells of the largest rectangle of free cells that contains a free one."""
    spans = [_span(line, column) for line in free]
    best, found = 0, ((row, column), (row, column))
    for first in range(row, -1, -1):
        if spans[first] is None:
            break
        left, right = 0, free.shape[1]
        for last in range(first, free.shape[0]):
            span = spans[last]
            if span is None:
                break
            left, right = max(left, span[0]), min(right, span[1])
            area = (last - first + 1) * (right - left + 1)
            if last >= row and area > best:
                best, found = area, ((first, left), (last, right))
    return found


def _span(line: Mask, column: int) -> tuple[int, int] | None:
    """The first and last of the free cells around one of a line; None if it is not free itself."""
    if not line[column]:
        return None
    blocked = np.flatnonzero(~line)
    before, behind = blocked[blocked < column], blocked[blocked > column]
    left = int(before[-1]) + 1 if len(before) else 0
    return left, int(behind[0]) - 1 if len(behind) else len(line) - 1
