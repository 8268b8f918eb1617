"""A room seen from above, as a grid: where there is floor or ceiling, and where something stands in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photonfarm.renderer.importing.proposal.pieces import Pieces
from photonfarm.renderer.importing.proposal.room import NEAR_FLOOR, Room
from photonfarm.renderer.importing.proposal.surfaces import Points

CELLS = 96
"""Cells along the longer side of the room."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlan:
    """The grid, and the points on everything that does not move."""

    low: Points  # (2,)
    cell: float
    shape: tuple[int, int]
    fixed: Points  # (M, 3)
    floor: Mask  # (A, B)
    ceiling: Mask  # (A, B)

    @classmethod
    def of(cls, pieces: Pieces, room: Room, fixed_pieces: NDArray[np.bool_]) -> Self:
        """The plan of a room; `fixed_pieces` (N,) are those that do not move."""
        cell = float(room.size[:2].max()) / CELLS
        a, b = (int(n) for n in np.maximum(np.ceil(room.size[:2] / cell), 1))
        chosen = fixed_pieces[pieces.sample_piece]
        fixed, flat = pieces.sample[chosen], pieces.sample_flat[chosen]
        nothing = np.zeros((a, b), np.bool_)
        plan = cls(room.low[:2].copy(), cell, (a, b), fixed, nothing, nothing)
        levels = []
        for height in (room.floor, room.high[2]):
            level = plan._marked(fixed[flat & (np.abs(fixed[:, 2] - height) < NEAR_FLOOR * room.height)])
            levels.append(ndimage.binary_closing(level, iterations=2, border_value=0) | level)
        return cls(plan.low, cell, plan.shape, fixed, *levels)

    def _marked(self, points: Points) -> Mask:
        place = np.floor((points[:, :2] - self.low) / self.cell).astype(np.int64)
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        mask: Mask = np.zeros(self.shape, np.bool_)
        mask[tuple(place[inside].T)] = True
        return mask

    def free(self, bottom: float, top: float, half: Points, level: Mask) -> Mask:
        """Where the middle of a box of half-lengths `half` (2,) may be: at floor or ceiling, and nothing in its way."""
        height = self.fixed[:, 2]
        blocked = self._marked(self.fixed[(height > bottom) & (height < top)])
        reach = np.ceil(half / self.cell).astype(int)
        blocked = ndimage.maximum_filter(blocked, size=tuple(2 * reach + 1), mode="constant", cval=1)
        free: Mask = ~blocked & (level if level.mean() > 0.05 else np.ones_like(level))
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
        return self.low + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.cell

    def widest_place(self, free: Mask) -> Points:
        """The point (2,) that is farthest from whatever is not free."""
        depth = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
        place: Points = self.middles[np.unravel_index(int(np.argmax(depth)), free.shape)]
        return place


def largest_rectangle(free: Mask, row: int, column: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The first and last cells of the largest rectangle of free cells that contains a free one."""
    best, found = 0, ((row, column), (row, column))
    for first in range(row, -1, -1):
        for last in range(row, free.shape[0]):
            blocked = np.flatnonzero(~free[first : last + 1].all(axis=0))
            left = int(blocked[blocked < column].max(initial=-1)) + 1
            right = int(blocked[blocked >= column].min(initial=free.shape[1])) - 1
            if right < column:
                break
            area = (last - first + 1) * (right - left + 1)
            if area > best:
                best, found = area, ((first, left), (last, right))
    return found
