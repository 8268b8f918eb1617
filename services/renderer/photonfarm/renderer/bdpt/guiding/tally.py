"""Tallies what light paths add to images: splats by the cell that they started in, connections by that of their vertex.

Index letters: T cells of starts; U cells of vertices; V images of a launch; C tiles of all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.camera import NoteSplat
from photonfarm.renderer.bdpt.guiding.grid import Grid, SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import Layout
from photonfarm.renderer.bdpt.guiding.usefulness import CELLS, cell_of
from photonfarm.renderer.bdpt.kept_vertices import KeptVertex

Totals: TypeAlias = "tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Float]"
"""The sums of a tally, in device memory."""

NoteConnection: TypeAlias = "Callable[[KeptVertex, mi.Spectrum, mi.Bool], None]"
"""A function of kept vertices of light paths, what connections to them add, and which are made."""

COLUMNS = 64
"""The most tiles of all images together: each image is cut into equal tiles, whose brightness says how noise counts."""


def tiles_of(images: int) -> int:
    """The tiles along each side of an image, for so many images."""
    return max(1, int(np.sqrt(COLUMNS / images)))


def column_of(image: mi.UInt32, x: mi.Float, y: mi.Float, tiles: int) -> mi.UInt32:
    """The number among the C of the tile at places in [0, 1)² of images."""
    return (image * tiles + mi.UInt32(y * tiles)) * tiles + mi.UInt32(x * tiles)


@dataclass(slots=True)
class Tally:
    """Sums over light paths by the cell that they started in, and over connections by the cell of their vertex."""

    splat_squares: mi.Float  # [T·C]: of what splats add to pixels of tiles; means over eye paths and light paths
    starts: mi.Float  # [T]: their number
    edges: mi.Float  # [T]: edges that they were traced along, which is what they cost
    connection_squares: mi.Float  # [U·C]: of what connections add to pixels of tiles; [C] without connections
    connections: mi.Float  # [U]: their number
    grid: Grid  # of the cells of vertices
    lanes: SparseLanes
    tiles: int  # along each side of an image, C = V·tiles²
    columns: int  # C
    cells: mi.UInt32 = field(default_factory=mi.UInt32)  # that the launch's light paths started in

    @classmethod
    def empty(cls, layout: Layout, grid: Grid, lanes: SparseLanes) -> Tally:
        """A tally of nothing, for a launch."""
        tiles = tiles_of(lanes.images)
        columns = lanes.images * tiles**2
        cells = CELLS if lanes.shifts is not None else 1
        return cls(
            splat_squares=dr.zeros(mi.Float, layout.cells * columns),
            starts=dr.zeros(mi.Float, layout.cells),
            edges=dr.zeros(mi.Float, layout.cells),
            connection_squares=dr.zeros(mi.Float, cells * columns),
            connections=dr.zeros(mi.Float, cells),
            grid=grid,
            lanes=lanes,
            tiles=tiles,
            columns=columns,
        )

    @property
    def totals(self) -> Totals:
        """All sums."""
        return self.splat_squares, self.starts, self.edges, self.connection_squares, self.connections

    def begin_paths(self, cells: mi.UInt32) -> None:
        """Note the cells that the light paths start in."""
        dr.eval(cells)
        self.cells = cells
        dr.scatter_add(self.starts, mi.Float(1), cells)

    def end_paths(self, edges: mi.UInt32) -> None:
        """Note the edges that the light paths were traced along."""
        dr.scatter_add(self.edges, mi.Float(edges), self.cells)

    def splats(self, image: mi.UInt32, light_ratio: mi.Float) -> NoteSplat:
        """What notes the splats of light paths of these images, so many for each eye path."""
        weight = dr.rsqrt(light_ratio * mi.Float(self.lanes.counts[2]))

        def note(position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
            x, y = position.x / self.lanes.width, position.y / self.lanes.height
            column = column_of(image, x, y, self.tiles)
            dr.scatter_add(self.splat_squares, _square(value * weight), self.cells * self.columns + column, active)

        return note

    def connections_of(self, image: mi.UInt32, pixel: mi.UInt32) -> NoteConnection:
        """What notes the connections of eye paths through these pixels of images."""
        row = pixel // self.lanes.width
        x, y = mi.Float(pixel - row * self.lanes.width) / self.lanes.width, mi.Float(row) / self.lanes.height
        column, weight = column_of(image, x, y, self.tiles), float(1 / np.sqrt(self.lanes.eyes))

        def note(vertex: KeptVertex, value: mi.Spectrum, active: mi.Bool) -> None:
            cell = cell_of(self.grid, vertex.si)
            active = active & (vertex.depth > 0)  # `&=` would change the caller's
            dr.scatter_add(self.connection_squares, _square(value * weight), cell * self.columns + column, active)
            dr.scatter_add(self.connections, mi.Float(1), cell, active)

        return note


def _square(value: mi.Spectrum) -> mi.Float:
    """The square of the mean of the colours."""
    return dr.square((value[0] + value[1] + value[2]) / 3)
