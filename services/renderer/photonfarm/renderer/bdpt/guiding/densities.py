"""Gains from sums over few light paths. Pure numpy.

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

import numpy as np

from photonfarm.renderer.bdpt.guiding.starts import F64, Layout

DEFAULT_SHARE = 0.35
"""The share of light paths that start as without a guide: no light is lost, and no density is below this part."""

PRIOR = 16.0
"""The number of light paths that the estimate of the coarser cell counts for; rare bright ones would mislead else."""


def gains(layout: Layout, splats: F64, joined: float, starts: F64, edges: F64, probability: F64) -> F64:
    """The gains [T], with the mean 1 over default sampling; all are 1 where no light path added anything.

    ``splats`` [T] are sums of weighted squares of what splats of the ``starts`` [T] light paths, of ``edges`` [T]
    together, added to pixels, and ``joined`` is that of all connections. ``probability`` [N] is the default one of each
    light.
    """
    of_connections = joined / max(edges.sum(), 1.0)
    of_splats = _means(layout, splats, starts) / np.maximum(_means(layout, edges, starts), 1)
    gain = np.sqrt(of_splats + of_connections)
    gain = gain.reshape(layout.lights, layout.of_a_light)
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
