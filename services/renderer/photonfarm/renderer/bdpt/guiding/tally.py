"""The tally from which a guide learns which starts of light paths and which of their vertices are useful.

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
"""Notes connections: the vertices of light paths that they go to, the radiance that each adds to its eye path's
estimate, and which are made."""

MOST_TILES = 64
"""The most tiles of all images together: each image is cut into equal tiles, whose brightness says how noise counts."""


def tiles_per_side(images: int) -> int:
    """The number of tiles along each side of an image, for so many images."""
    return max(1, int(np.sqrt(MOST_TILES / images)))


def tile_of(image: mi.UInt32, x: mi.Float, y: mi.Float, side: int) -> mi.UInt32:
    """The number among the C tiles of the one at (x, y) in [0, 1)² of an image of ``side``² tiles."""
    return (image * side + mi.UInt32(y * side)) * side + mi.UInt32(x * side)


@dataclass(slots=True)
class Tally:
    """Sums over light paths by the cell of their start, and over connections by the cell of their light vertex.

    Values are weighted so that the sums of squares of both kinds estimate the same: the variance of a pixel, the mean
    over an image's pixels, at one eye path per pixel.

    - A splat of the value v adds v/n_T to its pixel, with n_T light paths per eye path. Then the n_T light paths per
      pixel add n_T·E[v²]/n_T² to its variance, and the mean of v²/n_T over the light paths of the tally estimates that.
    - A connection's value v is added to one pixel, whose variance gets E[v²]: the mean of v² over eye paths.
    """

    splat_squares: mi.Float  # [T·C]: of values of splats, by the tile that they fall in
    starts: mi.Float  # [T]: number of light paths
    edges: mi.Float  # [T]: number of edges of these paths, which is what they cost
    connection_squares: mi.Float  # [U·C]: of values of connections, by the tile of the eye path; [C] without any
    connections: mi.Float  # [U]: number of connections
    grid: Grid  # of the cells of vertices
    lanes: SparseLanes
    side: int  # tiles along each side of an image
    tile_count: int  # C = V·side²
    cells: mi.UInt32 = field(default_factory=mi.UInt32)  # of the start of each light path of the launch

    @classmethod
    def empty(cls, layout: Layout, grid: Grid, lanes: SparseLanes) -> Tally:
        """A tally of nothing, for a launch."""
        side = tiles_per_side(lanes.images)
        tile_count = lanes.images * side**2
        cells = CELLS if lanes.has_connections else 1
        return cls(
            splat_squares=dr.zeros(mi.Float, layout.cells * tile_count),
            starts=dr.zeros(mi.Float, layout.cells),
            edges=dr.zeros(mi.Float, layout.cells),
            connection_squares=dr.zeros(mi.Float, cells * tile_count),
            connections=dr.zeros(mi.Float, cells),
            grid=grid,
            lanes=lanes,
            side=side,
            tile_count=tile_count,
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

    def make_note_splat(self, image: mi.UInt32, light_ratio: mi.Float) -> NoteSplat:
        """A function that adds splats to the tally; ``light_ratio`` is n_T, of the images that will be guided."""
        _, _, light_paths = self.lanes.counts  # as data, of which another number compiles nothing
        weight = dr.rsqrt(light_ratio * mi.Float(light_paths))  # its square: the mean of v²/n_T over light paths

        def note(position: mi.Point2f, value: mi.Spectrum, active: mi.Bool) -> None:
            x, y = position.x / self.lanes.width, position.y / self.lanes.height
            tile = tile_of(image, x, y, self.side)
            dr.scatter_add(self.splat_squares, _square(value * weight), self.cells * self.tile_count + tile, active)

        return note

    def make_note_connection(self, image: mi.UInt32, pixel: mi.UInt32) -> NoteConnection:
        """A function that adds connections to the tally: of eye paths through these pixels of images."""
        row = pixel // self.lanes.width
        x, y = mi.Float(pixel - row * self.lanes.width) / self.lanes.width, mi.Float(row) / self.lanes.height
        tile = tile_of(image, x, y, self.side)
        weight = float(1 / np.sqrt(self.lanes.eyes))  # its square: the mean of v² over eye paths

        def note(vertex: KeptVertex, value: mi.Spectrum, active: mi.Bool) -> None:
            cell = cell_of(self.grid, vertex.si)
            active = active & vertex.is_there  # not `&=`, which would change the caller's mask
            dr.scatter_add(self.connection_squares, _square(value * weight), cell * self.tile_count + tile, active)
            dr.scatter_add(self.connections, mi.Float(1), cell, active)

        return note


def _square(value: mi.Spectrum) -> mi.Float:
    """The square of the mean of the colours."""
    return dr.square((value[0] + value[1] + value[2]) / 3)
