"""How noisy a candidate's images are, also where the pilot is too short to see all of its noise.

Shape letters: H W image, B × B blocks. All is measured in images of the pilot, whatever their samples per pixel. Seen
from a pixel, x is its value, r the reference of the view, and y = x/√(r² + ε·mean(r)²) its weighted value; so that the
mean variance of y is the relative mean squared error (relMSE) of one image. ε = 0.01, as in `statistics.relative_mse`.

**Noise that is seen.** Two independent images a, b of one view give mean (y_a − y_b)²/2.

**Noise that all share.** Some light no technique finds well (a caustic seen in a mirror). With equal seeds all
candidates have the same rare bright samples of it, and whether a short pilot has one is chance. In each pair that part
is the mean over pixels of the least (y_a − y_b)²/2 of all candidates, and what of it exceeds 8 times its median over
the pairs of a view is not counted. Where that part rules, candidates differ by their time at most; where it does not,
without bound.

**Noise that is not seen.** A technique that finds some light with a small probability q a sample has a variance of
about E²/q there, E the light's share in y; but in a pilot of N samples with N·q < 1 it mostly sees neither that
variance nor that light. The light is then missing from its mean. As all candidates have one mean, its mean m over N
independent pixels of images has E[N·(m − μ)²] = var y, whatever the tails; so where another candidate d finds
significantly more, the candidate is charged with

    missed = mean over blocks of max over d of  N · max(0, (m_d − m)² − z²·(s² + s_d²)),    m_d > m,

N the pixels behind the mean that fewer are behind (what little evidence there is against a candidate does not grow with
the candidate's own images), s the standard errors of the block means: nothing while a deficit is within z = 4 standard
errors, and growing from 0 beyond. It is what is least plausible (an event missed by N samples is as rare as 1/N, or
rarer), so that it understates what is missed. One lucky sample does not convict others: a mean that rests on one sample
has a standard error of its own size. The blocks are tried at several sizes, since light may be missing in a spot or all
over; the largest counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.records import F32
from photonfarm.shared.statistics import block_means

EPSILON = 0.01
BLOCKS = (1, 4, 16)
"""Blocks along each side of the image, for missing light."""

SIGNIFICANT = 4.0
"""Standard errors: by chance once in 30 000 blocks, and then charged with next to nothing."""

SHARED = 8.0
"""Times the median of what all candidates share, beyond which it is not counted."""

Blocks = NDArray[np.float64]


def view_weights(images: Sequence[F32]) -> F32 | None:
    """1/√(r² + ε·mean(r)²) of a view, (H, W, 3), from images that serve for nothing else; None of a black view.

    These must not be among those that are weighted: a bright sample in r would divide itself away, and with it just the
    noise that is looked for. r is the mean image, or where it is brighter its mean over 3 × 3 pixels: few images miss a
    light that a pixel holds a corner of, but not in all pixels around.
    """
    pooled = np.mean(images, axis=0, dtype=np.float64)
    edged = np.pad(pooled, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(edged, (3, 3), axis=(0, 1)).mean(axis=(-2, -1))
    floor = EPSILON * float(np.mean(pooled)) ** 2
    return None if floor == 0 else (1 / np.sqrt(np.maximum(pooled, around) ** 2 + floor)).astype(np.float32)


@dataclass(slots=True)
class _Grid:
    """Sums over a tally's images for one size of blocks."""

    pixels: float  # per block
    mean: Blocks | float = 0.0  # sum over images of the block means of y
    pixel_variance: Blocks | float = 0.0  # sum over pairs, mean over a block's pixels
    block_variance: Blocks | float = 0.0  # sum over pairs, of the block means


def pair_errors(pairs: Sequence[tuple[F32, F32]], weights: F32) -> tuple[list[float], float]:
    """relMSE of one image by each candidate's pair of images, and what all of them share."""
    squares = [((a.astype(np.float64) - b) * weights) ** 2 / 2 for a, b in pairs]
    return [float(square.mean()) for square in squares], float(np.minimum.reduce(squares).mean())


def not_counted(shared: Sequence[float]) -> NDArray[np.float64]:
    """The part that is not counted of what all candidates share, for each pair of images of a view."""
    return np.maximum(np.array(shared) - SHARED * np.median(shared), 0)


@dataclass(slots=True)
class Tally:
    """Sums over one candidate's images of one view, for the light that is missing."""

    pairs: int = 0
    _grids: dict[int, _Grid] = field(default_factory=dict)

    def add(self, a: F32, b: F32, weights: F32) -> None:
        """Take two independent images, (H, W, 3)."""
        grey = (np.stack([a, b]).astype(np.float64) * weights).mean(axis=-1, keepdims=True)
        self.pairs += 1
        variance = (grey[:1] - grey[1:]) ** 2 / 2
        for blocks in BLOCKS:
            means = block_means(grey, blocks)
            grid = self._grids.setdefault(blocks, _Grid(grey[0].size / means[0].size))
            grid.mean = grid.mean + means.sum(axis=0)
            grid.pixel_variance = grid.pixel_variance + block_means(variance, blocks)[0]
            grid.block_variance = grid.block_variance + (means[0] - means[1]) ** 2 / 2

    def block_mean(self, blocks: int) -> tuple[Blocks, Blocks, float]:
        """Block means of y, (B, B), their squared standard errors, (B, B), and N, the pixels behind each.

        Pixels may depend on each other (light paths that several eye paths are joined to): of the variances by pixels
        and by images, the larger one counts.
        """
        grid, pairs = self._grids[blocks], self.pairs
        variance = np.maximum(np.asarray(grid.pixel_variance) / grid.pixels, grid.block_variance) / pairs
        return np.asarray(grid.mean) / (2 * pairs), variance / (2 * pairs), grid.pixels * 2 * pairs


def missed(tally: Tally, others: Sequence[Tally]) -> float:
    """The charge of the module's docstring for one view: relMSE of an image that a pilot was too short to see."""
    return max(_missed_in_blocks(tally, others, blocks) for blocks in BLOCKS)


def _missed_in_blocks(tally: Tally, others: Sequence[Tally], blocks: int) -> float:
    mean, variance, pixels = tally.block_mean(blocks)
    charge = np.zeros_like(mean)
    for other in others:
        more, more_variance, more_pixels = other.block_mean(blocks)
        deficit = np.maximum(more - mean, 0)
        unlikely = np.maximum(deficit**2 - SIGNIFICANT**2 * (variance + more_variance), 0)
        charge = np.maximum(charge, min(pixels, more_pixels) * unlikely)
    return float(charge.mean())
