"""A coarse grid over a scene's bounding box, whose cells number points of space."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

_MARGIN = 0.01373, 0.02291  # below and above the scene, over its extent: so that walls seldom lie between two cells


@dataclass(slots=True)
class Grid:
    """A grid of side³ cells, as data: a scene of another size recompiles nothing."""

    side: int
    lower: mi.Point3f  # [1]: its corner
    size: mi.Vector3f  # [1]: of a cell

    @classmethod
    def over(cls, box: mi.ScalarBoundingBox3f, side: int) -> Grid:
        """The grid over a bounding box."""
        low, extent = box.min, box.extents()
        lower = mi.Point3f(*(dr.opaque(mi.Float, float(low[k] - _MARGIN[0] * extent[k])) for k in range(3)))
        share = (1 + sum(_MARGIN)) / side
        size = mi.Vector3f(*(dr.opaque(mi.Float, max(float(extent[k]) * share, 1e-6)) for k in range(3)))
        return cls(side, lower, size)

    def place(self, p: mi.Point3f) -> mi.Vector3u:
        """The (x, y, z) of the cell that points lie in or are next to; some cell for points that are not finite.

        The last minimum sees to that: NaN converts to what the processor likes, with AVX2 far outside the grid.
        """
        place = dr.clip((p - self.lower) * dr.rcp(self.size), 0, self.side - 0.5)
        return dr.minimum(mi.Vector3u(place), self.side - 1)

    def cell(self, p: mi.Point3f) -> mi.UInt32:
        """The number of that cell, (z·side + y)·side + x."""
        x, y, z = self.place(p)
        return (z * self.side + y) * self.side + x
