"""Learns a guide from what light paths of default sampling add to some images.

The error that counts is the sum over pixels of variance/(r² + ε·mean²), with the mean brightness of the pixel's tile
for r. Light paths of a cell account for E[Σ v²/(r² + ε·mean²)]/q of it, with v what one adds to a pixel by splats and q
the cell's probability, and their edges for the time. So error × time is least for q in proportion to the root of the
second moment over the edges. Both are estimated coarse to fine: where only a few light paths started in a cell, its
estimate is that of the four cells around it together.

What connections add hardly depends on q, as their vertices are drawn anew in proportion to their weights, whatever
cells they come from. So their second moment counts for all cells alike, over the mean number of edges: where most of
the error is theirs, light paths start nearly as without a guide.

Index letters as in `starts`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.camera import ImageStack
from photonfarm.renderer.bdpt.guiding.grid import SparseLanes
from photonfarm.renderer.bdpt.guiding.starts import F64, Layout, StartGuide, table_of
from photonfarm.renderer.bdpt.guiding.tally import Totals, tile_of, tiles_per_side
from photonfarm.renderer.bdpt.guiding.usefulness import CELLS, estimate_usefulness

DEFAULT_SHARE = 0.35
"""The share of light paths that start as without a guide: no light is lost, and no density is below this part."""

PRIOR = 16.0
"""The number of light paths that the estimate of the coarser cell counts for; rare bright ones would mislead else."""

EPSILON = 1e-2
"""So that dark pixels do not count without bound; as in the pilot."""

SHARE = 32
"""The eye paths of an image for each eye path from which its guide is learned…"""

LIMITS = 1024, 65536
"""…and the least and the most of these."""


def estimate_gains(layout: Layout, splats: F64, joined: float, starts: F64, edges: F64, probability: F64) -> F64:
    """The gains [T], with the mean 1 over default sampling; all are 1 where no light path added anything. Pure numpy.

    ``splats`` [T] are sums of weighted squares of what splats of the ``starts`` [T] light paths, of ``edges`` [T]
    together, added to pixels, and ``joined`` is that of all connections. ``probability`` [N] is the default one of each
    light.
    """
    of_connections = joined / max(edges.sum(), 1.0)
    of_splats = _means(layout, splats, starts) / np.maximum(_means(layout, edges, starts), 1)
    gain = np.sqrt(of_splats + of_connections)
    gain = gain.reshape(layout.lights, layout.cells_per_light)
    total = float((gain.mean(axis=1) * probability).sum())
    if not (np.isfinite(total) and total > 0):
        return np.ones(layout.cells)
    return np.asarray((1 - DEFAULT_SHARE) * gain.ravel() / total + DEFAULT_SHARE)


def _means(layout: Layout, sums: F64, starts: F64) -> F64:
    """The means [T] over light paths, each level of cells with the one above as a prior."""
    estimate = np.array([sums.sum() / max(starts.sum(), 1.0)])
    cells = layout.lights
    while True:
        s, n = sums.reshape(cells, -1).sum(axis=1), starts.reshape(cells, -1).sum(axis=1)
        estimate = (s + PRIOR * estimate) / (n + PRIOR)
        if cells == layout.cells:
            return np.asarray(estimate)
        cells *= 4
        estimate = np.repeat(estimate, 4)


@dataclass(frozen=True, slots=True)
class Effort:
    """The paths from which a guide is learned, over all images."""

    eye_paths: int = 4096
    light_paths: int = 8192

    @classmethod
    def for_image(cls, eye_paths: int, light_ratio: float, connections: int) -> Effort:
        """A few per cent of the work of an image of so many eye paths; one of few sizes, as each has its kernels.

        Connections teach from fewer light paths than splats do, as each light path is joined to many eye paths.
        """
        eyes = int(np.clip(2 ** np.round(np.log2(eye_paths / SHARE)), *LIMITS))
        of_an_eye = 2 ** np.round(np.log2(np.clip(2 * light_ratio, 0.5 if connections else 2, 16)))
        return cls(eyes, int(eyes * of_an_eye))


@dataclass(frozen=True, slots=True, eq=False)
class PathGuide:
    """What was learned of a scene: where light paths should start, and how useful their vertices are to connect to."""

    starts: StartGuide
    usefulness_table: mi.Float | None  # of a `Usefulness`; None without connections

    @classmethod
    def of(cls, starts: StartGuide, table: F64 | None) -> Self:
        """The guide of these parts. Raises ValueError unless all of a table's [U] numbers are finite and above 0."""
        return cls(starts, None if table is None else table_of(table, CELLS, "table of usefulness"))


def learn(layout: Layout, probability: mi.Float, images: ImageStack, totals: Totals, lanes: SparseLanes) -> PathGuide:
    """The guide that the images and the totals of a launch suggest, given default probabilities of lights [N]."""
    side = tiles_per_side(lanes.images)
    weight = _weights(images.radiance, lanes, side)
    tile_count = lanes.images * side**2

    def weigh(squares: mi.Float) -> mi.Float:
        tile = dr.arange(mi.UInt32, dr.width(squares)) % tile_count
        return dr.block_sum(squares * dr.gather(mi.Float, weight, tile), tile_count)

    def read(*arrays: mi.Float) -> list[F64]:
        return [np.array(values, np.float64) for values in arrays]

    splat_squares, started, edges, connection_squares, connections = totals
    splats, joined = read(weigh(splat_squares), weigh(connection_squares))
    gain = estimate_gains(layout, splats, float(joined.sum()), *read(started, edges, probability))
    table = estimate_usefulness(joined, *read(connections)) if lanes.has_connections else None
    return PathGuide.of(StartGuide.of(layout, gain), table)


def _weights(radiance: mi.Spectrum, lanes: SparseLanes, side: int) -> mi.Float:
    """What the variance of pixels counts for in the error, for each tile of images [V·H·W]; 0 in black images."""
    pixel = dr.arange(mi.UInt32, dr.width(radiance))
    image = pixel // lanes.pixels
    within = pixel - image * lanes.pixels
    row = within // lanes.width
    x, y = (mi.Float(within - row * lanes.width) + 0.5) / lanes.width, (mi.Float(row) + 0.5) / lanes.height
    tile = tile_of(image, x, y, side)
    grey, pixels = (dr.zeros(mi.Float, lanes.images * side**2) for _ in range(2))
    dr.scatter_add(grey, (radiance[0] + radiance[1] + radiance[2]) / 3, tile)
    dr.scatter_add(pixels, 1, tile)
    grey /= dr.maximum(pixels, 1)
    mean = dr.repeat(dr.block_sum(grey, side**2), side**2) / side**2
    level = dr.square(grey) + EPSILON * dr.square(mean)
    return dr.select(level > 0, dr.rcp(level), 0)
