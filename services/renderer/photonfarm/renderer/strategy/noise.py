"""How noisy a candidate's images are, including noise that the pilot is too short to see.

A candidate's error is the variance between its images, and where another finds significantly more light in some block
of the image, the variance that it must have there to have missed that light. Rare bright samples that all candidates
have at equal seeds do not count. The rest of this text says how much is significant, and how much is charged.

Shape letters: H W image, B × B blocks. All is measured in images of the pilot, whatever their samples per pixel. Seen
from a pixel, x is its value, r the reference of the view, and y = x/√(r² + ε·mean(r)²) its weighted value; so that the
mean variance of y is the relative mean squared error (relMSE) of one image. ε = 0.01.

**Noise that is seen.** Two independent images a, b of one view give mean (y_a − y_b)²/2.

**Noise that all share.** Some light no technique finds well (a caustic seen in a mirror). With equal seeds all
candidates have the same rare bright samples of it, and whether a short pilot has one is chance. In each pair that part
is the mean over pixels of the least (y_a − y_b)²/2 of all candidates, and what of it exceeds 8 times its median over
the pairs of a view is not counted. Where that part rules, candidates differ by their time at most; where it does not,
without bound. In later rounds "all" are those still measured, though one that was dropped may have avoided the sample:
it was dropped on pairs in which it took part, and from those left the same is subtracted, so that a choice among them
is off by the ratio of their times at most.

**Noise that is not seen.** A technique that finds some light with a small probability q a sample has a variance of
about E²/q there, E the light's share in y; but in a pilot of N samples with N·q < 1 it mostly sees neither that
variance nor that light. The light is then missing from its mean. As all candidates have one mean, its mean m over N
independent samples has E[N·(m − μ)²] = var y, whatever the tails; so where another candidate d finds significantly
more, the candidate is charged with

    missed = mean over blocks of max over d of  N · max(0, (m_d − m)² − t²·(s² + s_d²)),    m_d > m,

N the samples behind the mean that fewer are behind (what little evidence there is against a candidate does not grow
with the candidate's own images), s the standard errors of the block means: nothing while a deficit is within t standard
errors, and growing from 0 beyond. It is what is least plausible (an event missed by N samples is as rare as 1/N, or
rarer), so that it understates what is missed. One lucky sample does not convict others: a mean that rests on one sample
has a standard error of its own size. The blocks are tried at several sizes, since light may be missing in a spot or all
over; the largest counts.

**How sure that is.** Pixels depend on each other where eye paths are joined to the same light paths: a block mean then
has ρ times the variance that independent pixels would give it, measured up to 40. So in a block of n pixels

    s² = max(ρ · mean variance of a pixel / n, variance between the images) / images,    N = n · images / ρ.

One block has few pairs of images, but a candidate's settings are the same everywhere: of each pair in each view, R is
the mean over the M blocks of (variance of the block mean between the two images) / (mean variance of a pixel / n), and
ρ the mean of R, 1 at least. Pairs are independent, the blocks of one image may not be: by Satterthwaite's rule a pair
has 2·mean(R)²/var(R) degrees of freedom, between 1 and M, and s² that times the number of pairs. Where the variance
between its images is the larger, as near a light, a block stands for itself, with the pairs of its view. A difference
has the degrees of freedom ν of Welch and Satterthwaite, and t is the quantile of Student's distribution at the
probability that a normal one exceeds z = 4, rather too large for small ν: 210 for ν = 2, 7.7 for ν = 8, 4.3 for ν = 64.
So a single pair convicts next to nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.records import F32
from photonfarm.shared.core.statistics import block_means

EPSILON = 0.01
BLOCKS = (1, 4, 16)
"""The numbers of blocks along each side of the image, for missing light."""

SIGNIFICANT = 4.0
"""The limit in standard errors, if these were exact: exceeded by chance once in 30 000 blocks, at almost no charge."""

SHARED = 8.0
"""The multiple of its median beyond which the part that all candidates share is not counted."""

Blocks = NDArray[np.float64]


def view_weights(images: Sequence[F32]) -> F32 | None:
    """1/√(r² + ε·mean(r)²) of a view, (H, W, 3), from images that serve no other purpose; None for a black view.

    The weighted images must not be among them: a bright sample in r would divide itself away, and with it the very
    noise to be measured. r is the mean image, or its mean over 3 × 3 pixels where that is brighter: few images may miss
    a light in the corner of a pixel, but not in all pixels around it.
    """
    pooled = np.mean(images, axis=0, dtype=np.float64)
    edged = np.pad(pooled, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(edged, (3, 3), axis=(0, 1)).mean(axis=(-2, -1))
    floor = EPSILON * float(np.mean(pooled)) ** 2
    return None if floor == 0 else (1 / np.sqrt(np.maximum(pooled, around) ** 2 + floor)).astype(np.float32)


def pair_errors(pairs: Sequence[tuple[F32, F32]], weights: F32) -> tuple[list[float], float]:
    """The relMSE of one image from each candidate's pair of images, and the part that all of them share."""
    squares = [((a.astype(np.float64) - b) * weights) ** 2 / 2 for a, b in pairs]
    return [float(square.mean()) for square in squares], float(np.minimum.reduce(squares).mean())


def not_counted(shared: Sequence[float]) -> NDArray[np.float64]:
    """The uncounted part of what all candidates share, for each pair of images of a view."""
    return np.maximum(np.array(shared) - SHARED * np.median(shared), 0)


@dataclass(slots=True)
class _Grid:
    """Sums over the images of one view for one size of blocks."""

    pixels: float  # per block
    pairs: int = 0
    mean: Blocks | float = 0.0  # sum over images of the block means of y
    pixel_variance: Blocks | float = 0.0  # sum over pairs, mean over a block's pixels
    block_variance: Blocks | float = 0.0  # sum over pairs, of the block means


@dataclass(frozen=True, slots=True)
class _Evidence:
    """The statistics of the block means of y for one size of blocks, in V views."""

    mean: Blocks  # (V, B, B)
    variance: Blocks  # (V, B, B), squared standard errors
    samples: Blocks  # (V, 1, 1), independent ones behind each mean
    freedom: Blocks  # (V, B, B), degrees of freedom of the variance


@dataclass(slots=True)
class BlockSums:
    """Sums over one candidate's images of all views, for the light that is missing."""

    _grids: dict[int, dict[int, _Grid]] = field(default_factory=dict)  # by size and view
    _ratios: dict[int, list[float]] = field(default_factory=dict)  # by size: the ratio that ρ is the mean of, by pairs

    def add(self, a: F32, b: F32, weights: F32, view: int = 0) -> None:
        """Add two independent images of a view, (H, W, 3)."""
        grey = (np.stack([a, b]).astype(np.float64) * weights).mean(axis=-1, keepdims=True)
        variance = (grey[:1] - grey[1:]) ** 2 / 2
        for blocks in BLOCKS:
            means = block_means(grey, blocks)
            grid = self._grids.setdefault(blocks, {}).setdefault(view, _Grid(grey[0].size / means[0].size))
            grid.pairs += 1
            of_pixels, of_block = block_means(variance, blocks)[0], (means[0] - means[1]) ** 2 / 2
            grid.mean = grid.mean + means.sum(axis=0)
            grid.pixel_variance = grid.pixel_variance + of_pixels
            grid.block_variance = grid.block_variance + of_block
            noisy = of_pixels > 0
            ratio = grid.pixels * float(np.mean(of_block[noisy] / of_pixels[noisy])) if noisy.any() else 1.0
            self._ratios.setdefault(blocks, []).append(ratio)

    def evidence(self, blocks: int) -> _Evidence:
        """The means, standard errors, N and ν of the module's docstring."""
        grids, ratios = list(self._grids[blocks].values()), np.array(self._ratios[blocks])
        pairs = np.array([[[float(grid.pairs)]] for grid in grids])
        independent = np.stack([np.asarray(grid.pixel_variance) for grid in grids]) / (grids[0].pixels * pairs)
        between = np.stack([np.asarray(grid.block_variance) for grid in grids]) / pairs
        dependence = max(1.0, float(ratios.mean()))
        scatter = ratios.var(ddof=1) if len(ratios) > 1 else np.inf
        pooled = len(ratios) * np.clip(2 * ratios.mean() ** 2 / max(scatter, 1e-30), 1, between[0].size)
        return _Evidence(
            mean=np.stack([np.asarray(grid.mean) for grid in grids]) / (2 * pairs),
            variance=np.maximum(dependence * independent, between) / (2 * pairs),
            samples=2 * pairs * grids[0].pixels / dependence,
            freedom=np.where(between > dependence * independent, pairs, pooled),
        )


def missed(tally: BlockSums, others: Sequence[BlockSums]) -> float:
    """The charge of the module's docstring, mean over the views: relMSE that the pilot was too short to see.

    All tallies are of the same views, in the same order.
    """
    return float(np.max([_missed_in_blocks(tally, others, blocks) for blocks in BLOCKS], axis=0).mean())


def _missed_in_blocks(tally: BlockSums, others: Sequence[BlockSums], blocks: int) -> NDArray[np.float64]:
    """The charge of each view, (V,), for one size of blocks."""
    own = tally.evidence(blocks)
    charge = np.zeros_like(own.mean)
    for more in (other.evidence(blocks) for other in others):
        deficit = np.maximum(more.mean - own.mean, 0)
        unlikely = np.maximum(deficit**2 - _limit(own, more), 0)
        charge = np.maximum(charge, np.minimum(own.samples, more.samples) * unlikely)
    return np.asarray(charge.mean(axis=(1, 2)))


def _limit(a: _Evidence, b: _Evidence) -> Blocks:
    """t²·(s² + s_d²): the square of the difference of two block means that chance explains, (V, B, B).

    The quantile is that of `statistics.student_to_normal`, solved for t.
    """
    variance = a.variance + b.variance
    pieces = a.variance**2 / a.freedom + b.variance**2 / b.freedom
    freedom = np.divide(variance**2, pieces, out=np.ones_like(variance), where=pieces > 0)
    z = SIGNIFICANT * (8 * freedom + 3) / (8 * freedom + 1)
    return np.asarray(freedom * np.expm1(z**2 / freedom) * variance)
