"""Tallies what light paths add to images, by the cell that they started in.

Index letters: T cells of a guide's table; C tiles of all images of a launch.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.film import Splat
from photonfarm.renderer.bdpt.guiding.sparse_lanes import SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import Layout

COLUMNS = 64
"""The most tiles of all images together: each image is cut into equal tiles, whose brightness says how noise counts."""


@dataclass(slots=True)
class Tally:
    """Sums over light paths, by the cell that they started in and the tile of the image that they add to."""

    squares: mi.Float  # [T·C]: squares of what is added to pixels; over eye paths and over light paths per eye path
    starts: mi.Float  # [T]: light paths
    tiles: int  # along each side of an image; C = images · tiles²
    images: int

    @classmethod
    def empty(cls, layout: Layout, images: int) -> Tally:
        """A tally of nothing."""
        tiles = cls.tiles_of(images)
        return cls(
            dr.zeros(mi.Float, layout.cells * images * tiles**2), dr.zeros(mi.Float, layout.cells), tiles, images
        )

    @staticmethod
    def tiles_of(images: int) -> int:
        """The tiles along each side of an image, for so many images."""
        return max(1, int(np.sqrt(COLUMNS / images)))

    def column(self, image: mi.UInt32, x: mi.Float, y: mi.Float) -> mi.UInt32:
        """The number of the tile at a place in [0, 1)² of an image."""
        return (image * self.tiles + mi.UInt32(y * self.tiles)) * self.tiles + mi.UInt32(x * self.tiles)

    def add(self, cell: mi.UInt32, column: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add what light paths of ``cell`` add to tiles."""
        grey = (value[0] + value[1] + value[2]) / 3
        dr.scatter_add(self.squares, dr.square(grey), cell * (self.images * self.tiles**2) + column, active)


@dataclass(slots=True)
class TalliedSplat(Splat):
    """A stack of images whose splats are tallied too."""

    tally: Tally
    number: mi.UInt32  # of the image that a lane's light path belongs to
    weight: mi.Float  # [1]: root of what a light path counts for in the tally's sums
    cell: mi.UInt32  # that a lane's light path started in

    @classmethod
    def of(cls, splat: Splat, tally: Tally, number: mi.UInt32, weight: mi.Float) -> TalliedSplat:
        """A splat that is tallied too; its light paths have yet to begin."""
        own = (splat.image, splat.scale, splat.offset, splat.width, splat.height)
        return cls(*own, tally, number, weight, mi.UInt32(0))

    def begin(self, cell: mi.UInt32) -> None:
        """Note the cells that the light paths start in."""
        dr.eval(cell)
        self.cell = cell
        dr.scatter_add(self.tally.starts, mi.Float(1), cell)

    def add(self, position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add ``value`` at ``position``, in pixels of the crop window; what falls outside is lost."""
        Splat.add(self, position, value, active)
        inside = active & dr.all((position >= 0) & (position < mi.ScalarVector2f(self.width, self.height)))
        column = self.tally.column(self.number, position.x / self.width, position.y / self.height)
        self.tally.add(self.cell, column, value * self.weight, inside)


@dataclass(slots=True)
class TalliedConnections:
    """Connections whose values are tallied."""

    tally: Tally
    cells: mi.UInt32  # that each light path of the launch started in
    column: mi.UInt32  # of a lane's pixel
    weight: mi.Float  # [1]: root of what an eye path counts for in the tally's sums

    @classmethod
    def of(
        cls, tally: Tally, cells: mi.UInt32, image: mi.UInt32, pixel: mi.UInt32, lanes: SparseLanes
    ) -> TalliedConnections:
        """Those of a launch whose lanes see pixels of images."""
        row = pixel // lanes.width
        x, y = mi.Float(pixel - row * lanes.width) / lanes.width, mi.Float(row) / lanes.height
        return cls(tally, cells, tally.column(image, x, y), mi.Float(1 / np.sqrt(lanes.eyes)))

    def add(self, path: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add the ``value`` of connections to light paths ``path``."""
        self.tally.add(dr.gather(mi.UInt32, self.cells, path, active), self.column, value * self.weight, active)
