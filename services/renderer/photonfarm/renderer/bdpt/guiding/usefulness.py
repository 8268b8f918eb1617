"""How useful vertices of light paths are for connections, by the place where they lie and by their normal.

Index letters: U = SIDE³·6 cells, those of a grid over the scene for each of six normals; C tiles of images, as in
`tally`.

A connection to a vertex of the cell c adds the square of its value v to the variance of a pixel. Where vertices are
drawn with the weights w, v goes with 1/w, so the variance is least for w in proportion to the root of E[v²·w²]. With
the throughput as the weight of the vertices from which it is learned, this is their throughput times the root of the
mean of v² over the connections to the cell: its usefulness.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.bdpt.guiding.grid import Grid
from photonfarm.renderer.bdpt.scenes import bounding_box

F64 = NDArray[np.float64]

SIDE = 16
"""Cells along each axis of the scene's box."""

NORMALS = 6
"""Kinds of normals: the axis that they are nearest to, and which way along it."""

CELLS = SIDE**3 * NORMALS

PRIOR = 16.0
"""The number of connections that the estimate of the coarser cell counts for."""

LEAST = 0.25
"""The least usefulness, where 1 is the mean: light that learning has not seen is not lost."""


@dataclass(slots=True)
class Usefulness:
    """A table over a scene."""

    grid: Grid
    table: mi.Float  # [U]: 1 on average over the vertices to which connections were made

    @classmethod
    def over(cls, scene: mi.Scene, table: mi.Float) -> Usefulness:
        """The table over a scene as it is now."""
        return cls(Grid.over(bounding_box(scene), SIDE), table)

    def at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """The usefulness of surface points. It is the same for all paths through a point, which the weights need."""
        return dr.gather(mi.Float, self.table, cell_of(self.grid, si), active)


def cell_of(grid: Grid, si: mi.SurfaceInteraction3f) -> mi.UInt32:
    """The number of the cell that surface points lie in."""
    x, y, z = dr.abs(si.n)
    axis = dr.select((x >= y) & (x >= z), mi.UInt32(0), dr.select(y >= z, mi.UInt32(1), mi.UInt32(2)))
    along = dr.select(axis == 0, si.n.x, dr.select(axis == 1, si.n.y, si.n.z))
    return grid.cell(si.p) * NORMALS + 2 * axis + dr.select(along < 0, mi.UInt32(1), mi.UInt32(0))


def estimate_usefulness(sums: F64, connections: F64) -> F64:
    """The table [U] from sums of weighted squares over the ``connections`` [U] to vertices of each cell. Pure numpy.

    It is estimated coarse to fine, as few connections go to most cells. All are 1 where no connection added anything.
    """
    root_means = np.sqrt(_means(*(a.reshape(SIDE, SIDE, SIDE, NORMALS) for a in (sums, connections)))).ravel()
    mean = (root_means * connections).sum() / max(connections.sum(), 1.0)
    if not (np.isfinite(mean) and mean > 0):
        return np.ones(CELLS)
    return np.asarray(np.maximum(root_means / mean, LEAST))


def _means(sums: F64, counts: F64) -> F64:
    """The means [SIDE, SIDE, SIDE, NORMALS], each level of cells with the one above as a prior."""
    estimate = np.zeros((1, 1, 1)) + sums.sum() / max(counts.sum(), 1.0)
    side = 1
    while side < SIDE:
        side *= 2
        for axis in range(3):
            estimate = np.repeat(estimate, 2, axis)
        edge = SIDE // side
        s, n = (a.reshape(side, edge, side, edge, side, edge * NORMALS).sum(axis=(1, 3, 5)) for a in (sums, counts))
        estimate = (s + PRIOR * estimate) / (n + PRIOR)
    return np.asarray((sums + PRIOR * estimate[..., None]) / (counts + PRIOR))
