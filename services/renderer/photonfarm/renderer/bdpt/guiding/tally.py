"""Tallies what light paths add to images, by the cell that they started in.

Index letters: T cells of a guide's table; V images of a launch; C tiles of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.film import Splat
from photonfarm.renderer.bdpt.guiding.sparse_lanes import SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import Layout
from photonfarm.renderer.bdpt.launches import Lanes

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
    """Sums over light paths, by the cell that they started in."""

    squares: mi.Float  # [T·C]: of what they add to pixels of tiles; means over eye paths and light paths
    starts: mi.Float  # [T]: their number
    edges: mi.Float  # [T]: edges that they were traced along, which is what they cost
    tiles: int = 0  # along each side of an image, C = V·tiles²
    columns: int = 0  # C
    eye_weight: float = 0.0  # root of what a square counts for by which an eye path adds to its pixel
    cells: mi.UInt32 = field(default_factory=mi.UInt32)  # that the launch's light paths started in

    @classmethod
    def empty(cls, layout: Layout, lanes: SparseLanes) -> Tally:
        """A tally of nothing, for a launch."""
        tiles = tiles_of(lanes.images)
        columns = lanes.images * tiles**2
        squares, starts, edges = (dr.zeros(mi.Float, n) for n in (layout.cells * columns, layout.cells, layout.cells))
        return cls(squares, starts, edges, tiles, columns, float(1 / np.sqrt(lanes.eyes)))

    @property
    def sums(self) -> tuple[mi.Float, mi.Float, mi.Float]:
        """All sums."""
        return self.squares, self.starts, self.edges

    def add(self, cell: mi.UInt32, column: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add what light paths of ``cell`` add to tiles."""
        grey = (value[0] + value[1] + value[2]) / 3
        dr.scatter_add(self.squares, dr.square(grey), cell * self.columns + column, active)


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
        self.tally.add(self.tally.cells, column, value * self.weight, inside)


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

    def add(self, path: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add the ``value`` of connections to light paths ``path``."""
        cell = dr.gather(mi.UInt32, self.tally.cells, path, active)
        self.tally.add(cell, self.column, value * self.tally.eye_weight, active)
