"""Tallies what light paths add to images: splats by the cell that they started in, connections by that of their vertex.

Index letters: T cells of starts; U cells of vertices; V images of a launch; C tiles of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.camera import Splat
from photonfarm.renderer.bdpt.guiding.grid import Grid, SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import Layout
from photonfarm.renderer.bdpt.guiding.usefulness import CELLS, cell_of
from photonfarm.renderer.bdpt.kept_vertices import KeptVertex
from photonfarm.renderer.bdpt.launches import Lanes

Totals: TypeAlias = "tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Float]"
"""The sums of a tally, in device memory."""

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
    tiles: int  # along each side of an image, C = V·tiles²
    columns: int  # C
    eye_weight: float  # root of what a square counts for by which an eye path adds to its pixel
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
            tiles=tiles,
            columns=columns,
            eye_weight=float(1 / np.sqrt(lanes.eyes)),
        )

    @property
    def totals(self) -> Totals:
        """All sums."""
        return self.splat_squares, self.starts, self.edges, self.connection_squares, self.connections

    def add_splat(self, cell: mi.UInt32, column: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add what splats of light paths of ``cell`` add to tiles."""
        dr.scatter_add(self.splat_squares, _square(value), cell * self.columns + column, active)

    def add_connection(self, vertex: KeptVertex, column: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add what connections to light vertices add to tiles."""
        cell = cell_of(self.grid, vertex.si)
        active = active & (vertex.depth > 0)  # `&=` would change the caller's
        dr.scatter_add(self.connection_squares, _square(value), cell * self.columns + column, active)
        dr.scatter_add(self.connections, mi.Float(1), cell, active)


def _square(value: mi.Spectrum) -> mi.Float:
    """The square of the mean of the colours."""
    return dr.square((value[0] + value[1] + value[2]) / 3)


@dataclass(slots=True)
class TalliedSplat(Splat):
    """A stack of images whose splats are tallied too."""

    tally: Tally
    number: mi.UInt32  # of the image that a lane's light path belongs to
    weight: mi.Float  # [1]: root of what a square counts for by which a light path adds to a pixel

    @classmethod
    def of(cls, splat: Splat, tally: Tally, number: mi.UInt32, weight: mi.Float) -> TalliedSplat:
        """A splat that is tallied too."""
        return cls(splat.sums, splat.scale, splat.offset, splat.width, splat.height, tally, number, weight)

    def begin(self, cells: mi.UInt32) -> None:
        """Note the cells that the light paths start in."""
        dr.eval(cells)
        self.tally.cells = cells
        dr.scatter_add(self.tally.starts, mi.Float(1), cells)

    def end(self, edges: mi.UInt32) -> None:
        """Note the edges that the light paths were traced along."""
        dr.scatter_add(self.tally.edges, mi.Float(edges), self.tally.cells)

    def add(self, position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add ``value`` at ``position``, in pixels of the crop window; what falls outside is lost."""
        Splat.add(self, position, value, active)
        inside = active & dr.all((position >= 0) & (position < mi.ScalarVector2f(self.width, self.height)))
        column = column_of(self.number, position.x / self.width, position.y / self.height, self.tally.tiles)
        self.tally.add_splat(self.tally.cells, column, value * self.weight, inside)


@dataclass(slots=True)
class TalliedConnections:
    """Connections whose values are tallied."""

    tally: Tally
    column: mi.UInt32  # of a lane's pixel

    @classmethod
    def of(cls, tally: Tally, image: mi.UInt32, pixel: mi.UInt32, lanes: Lanes) -> TalliedConnections:
        """Those of a launch whose lanes see pixels of images."""
        row = pixel // lanes.width
        x, y = mi.Float(pixel - row * lanes.width) / lanes.width, mi.Float(row) / lanes.height
        return cls(tally, column_of(image, x, y, tally.tiles))

    def add(self, vertex: KeptVertex, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add the ``value`` of connections to kept vertices of light paths."""
        self.tally.add_connection(vertex, self.column, value * self.tally.eye_weight, active)
