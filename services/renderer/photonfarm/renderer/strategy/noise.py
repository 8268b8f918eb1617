"""The noise of a candidate's images: noise that the pilot sees, and a charge for light that it is too short to see.

Shape letters: H W image, B × B blocks, V views. Of a pixel, x is the value, r the reference, and y the weighted value.
For images, y = x/√(r² + ε·mean(r)²), and the mean variance of y is the relative mean squared error (relMSE) of one
image. For training, y = x·e/√((e·b)² + 0.05), e being the scene's exposure and b the mean of r over channels; and the
mean variance of y is the relative loss of a network that predicts the noise-free image.

**Noise that is seen** is mean (y_a − y_b)²/2 over two independent images a, b of a view. Rare bright samples that all
candidates share are left out (`pair_errors`).

**Light that is missed.** A technique that finds some light with a small probability may find none of it in a short
pilot. Its images then lack that light, and show no noise from it either. But all candidates have the same mean image,
so another candidate's images show what is missing. A mean m over N independent samples has E[N·(m − μ)²] = var y. So a
candidate whose mean m of a block is significantly below the mean m_d of another is charged N·(m_d − m)², less what
chance explains (`charge_for_missed`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.core.statistics import block_means

EPSILON = 0.01
"""ε, which bounds the weights of dark pixels in images."""

LOSS_EPSILON = 0.05
"""The ε of the trainer's relative loss, squared exposed radiance; a test compares it."""

BLOCKS = (1, 4, 16)
"""The numbers of blocks along each side of the image, for missing light."""

SIGNIFICANT = 4.0
"""The limit z, in standard errors: if these were exact, chance would exceed it in one of 30 000 blocks."""

RARE = 0.01
"""The share of the pixels that count as the worst: if their shared noise exceeds that of all others, it is rare."""

Blocks = NDArray[np.float64]


Weigh: TypeAlias = Callable[[Sequence[F32]], F32 | None]
"""Images of a view → the factors on its pixels, (H, W, 3), whose squares weigh variance; None for a black view."""


class Purpose(StrEnum):
    """What samples are for."""

    TRAINING = "training"  # targets of a network, weighed as the trainer's relative loss does
    IMAGES = "images"  # images to look at, or references

    def weigh(self, exposure: float) -> Weigh:
        """How the noise of pixels counts, in a scene of this exposure."""
        return partial(training_weights, exposure=exposure) if self is Purpose.TRAINING else view_weights


def view_weights(images: Sequence[F32]) -> F32 | None:
    """1/√(r² + ε·mean(r)²) of a view, (H, W, 3), from images that serve no other purpose; None for a black view."""
    floor = EPSILON * float(np.mean(images, dtype=np.float64)) ** 2
    return None if floor == 0 else (1 / np.sqrt(_reference(images) ** 2 + floor)).astype(np.float32)


def training_weights(images: Sequence[F32], exposure: float) -> F32 | None:
    """e/√((e·b)² + 0.05) of a view, (H, W, 3), from images that serve no other purpose; None for a black view.

    Its square is the weight of a squared error in the trainer's relative loss, at the noise-free image. In expectation
    the noise of a target adds its variance times this weight to the loss. A network that averages n targets of like
    weights has an n-th of that in its result. The weight is the same in all channels,
    and its floor the same in all views, so that dark views count little.
    """
    if not np.any(images):
        return None
    bright = exposure * _reference(images).mean(axis=-1, keepdims=True)
    weights = exposure / np.sqrt(bright**2 + LOSS_EPSILON)
    return np.broadcast_to(weights, images[0].shape).astype(np.float32)


def _reference(images: Sequence[F32]) -> NDArray[np.float64]:
    """r, (H, W, 3): the mean image, or its mean over 3 × 3 pixels where that is brighter.

    Few images may miss a light in the corner of a pixel, but not in all pixels around it. The images must not be among
    those that r weights: a bright sample in r would hide the noise that it causes. The noise of r remains in the
    weights. It is the same for all candidates, so that it biases their errors alike.
    """
    pooled = np.mean(images, axis=0, dtype=np.float64)
    edged = np.pad(pooled, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(edged, (3, 3), axis=(0, 1)).mean(axis=(-2, -1))
    return np.asarray(np.maximum(pooled, around))


def pair_errors(pairs: Sequence[tuple[F32, F32]], weights: F32) -> tuple[list[float], float]:
    """The error of one image from each candidate's pair of images, and the shared error that it leaves out.

    The error is the mean variance of y, relMSE or relative loss, less the error that is left out.

    Some light no technique finds well, such as a caustic seen in a mirror. With equal seeds all candidates have the
    same rare bright samples of it, and chance decides whether a short pilot has one. The shared noise of a pixel is the
    least (y_a − y_b)²/2 of all candidates. Where the worst 1 % of the pixels have more of it than all others together,
    what they have more, over the number of pixels, is subtracted from each candidate's error. At worst, where what is
    left out outweighs the rest, the choice is slower by the ratio of the candidates' times. In later rounds of a pilot
    the candidates are those still measured.
    """
    squares = [(((a.astype(np.float64) - b) * weights) ** 2 / 2).mean(axis=-1).ravel() for a, b in pairs]
    shared = np.sort(np.minimum.reduce(squares))
    rest, worst = np.split(shared, [-max(1, round(RARE * shared.size))])
    rare = max(float(worst.sum() - rest.sum()) / shared.size, 0.0)
    return [float(square.mean()) - rare for square in squares], rare


@dataclass(frozen=True, slots=True)
class _Evidence:
    """The statistics of the block means of y for one size of blocks, in V views."""

    mean: Blocks  # (V, B, B)
    variance: Blocks  # (V, B, B), squared standard errors
    samples: Blocks  # (V, 1, 1), independent ones behind each mean
    freedom: Blocks  # (V, B, B), degrees of freedom of the variance


class BlockSums:
    """The block means of one candidate's images of all views, from which `charge_for_missed` is computed."""

    def __init__(self) -> None:
        """Have no images yet."""
        self._views: list[int] = []  # of each pair of images
        self._pairs: dict[int, list[tuple[Blocks, Blocks, Blocks]]] = {blocks: [] for blocks in BLOCKS}
        """Mean of y, variance of y in a block's pixels, variance of its mean: of each pair, by size of blocks."""
        self._pixels = 0
        self._evidence: dict[int, _Evidence] = {}

    def add(self, a: F32, b: F32, weights: F32, view: int = 0) -> None:
        """Add two independent images of a view, (H, W, 3)."""
        y = (np.stack([a, b]).astype(np.float64) * weights).mean(axis=-1, keepdims=True)
        self._evidence.clear()
        self._views.append(view)
        self._pixels = y[0].size
        for blocks, pairs in self._pairs.items():
            means, of_pixels = block_means(y, blocks), block_means((y[:1] - y[1:]) ** 2 / 2, blocks)[0]
            pairs.append((means.mean(axis=0), of_pixels, (means[0] - means[1]) ** 2 / 2))

    def evidence(self, blocks: int) -> _Evidence:
        """The means of blocks of n pixels, their squared standard errors s², samples N and degrees of freedom.

            s² = max(ρ · mean variance of a pixel / n, variance between the images) / I,    N = n · I / ρ

        I is the number of images, two for each pair. Pixels depend on each other where eye paths are joined to the same
        light paths. R of a pair (`ratios`) is the mean over its M blocks of (variance of the block mean between the two
        images) / (mean variance of a pixel / n); it is 1 for independent pixels. One block has few pairs of images, but
        a candidate's settings are the same everywhere. So ρ is the mean of R over all pairs, and at least 1. Up to 40
        was measured.

        Pairs are independent, but the blocks of one image may not be. By Satterthwaite's rule a pair has
        2·mean(R)²/var(R) degrees of freedom, between 1 and M; s² has that times the number of pairs. Where the variance
        between the images is the larger one, as near a light, a block has one for each pair of its own view.
        """
        if blocks in self._evidence:
            return self._evidence[blocks]
        mean, of_pixels, of_block = (np.stack(column) for column in zip(*self._pairs[blocks], strict=True))
        n = self._pixels / mean[0].size
        noisy = of_pixels > 0
        ratios = np.array(
            [
                n * float(np.mean(block[some] / pixels[some])) if some.any() else 1.0
                for block, pixels, some in zip(of_block, of_pixels, noisy, strict=True)
            ]
        )
        views = np.array(self._views)
        of_view = [views == view for view in dict.fromkeys(self._views)]
        pairs = np.array([[[float(chosen.sum())]] for chosen in of_view])
        rho = max(1.0, float(ratios.mean()))
        independent = rho * np.stack([of_pixels[chosen].mean(axis=0) for chosen in of_view]) / n
        between = np.stack([of_block[chosen].mean(axis=0) for chosen in of_view])
        scatter = ratios.var(ddof=1) if len(ratios) > 1 else np.inf
        pooled = len(ratios) * np.clip(2 * ratios.mean() ** 2 / max(scatter, 1e-30), 1, mean[0].size)
        self._evidence[blocks] = _Evidence(
            mean=np.stack([mean[chosen].mean(axis=0) for chosen in of_view]),
            variance=np.maximum(independent, between) / (2 * pairs),
            samples=2 * pairs * n / rho,
            freedom=np.where(between > independent, pairs, pooled),
        )
        return self._evidence[blocks]


def charge_for_missed(sums: BlockSums, others: Sequence[BlockSums]) -> float:
    """The charge for light that other candidates find and this one misses, as an error, mean over the views.

    For each view it is the largest over the sizes of blocks, since light may be missing in a spot or everywhere, of

        mean over blocks of max over d of  N · max(0, (m_d − m)² − t²·(s² + s_d²)),    m_d > m.

    m and s are the candidate's block mean and its standard error, m_d and s_d those of another candidate d, and t is
    the limit of `_limit`. N is the smaller of the two numbers of samples, so that weak evidence against a candidate
    does not grow with the candidate's own images. The charge is 0 up to t standard errors, and grows from there. It
    takes 1/N for the probability of light that N samples missed. That probability may be lower, so the charge is rather
    too small. One lucky sample charges no other candidate: the standard error of its mean is as large as the mean.

    All sums are over the same views, in the same order.
    """
    charges = []
    for blocks in BLOCKS:
        own = sums.evidence(blocks)
        charge = np.zeros_like(own.mean)
        for more in (other.evidence(blocks) for other in others):
            deficit = np.maximum(more.mean - own.mean, 0)
            unlikely = np.maximum(deficit**2 - _limit(own, more), 0)
            charge = np.maximum(charge, np.minimum(own.samples, more.samples) * unlikely)
        charges.append(charge.mean(axis=(1, 2)))
    return float(np.max(charges, axis=0).mean())


def _limit(a: _Evidence, b: _Evidence) -> Blocks:
    """t²·(s² + s_d²): the square of the difference of two block means that chance explains, (V, B, B).

    The difference has the degrees of freedom ν of Welch and Satterthwaite. t is the quantile of Student's distribution
    at the probability with which a normal variable exceeds z = 4, by `statistics.student_to_normal` solved for t. That
    is rather too large for small ν: 210 for ν = 2, 7.7 for ν = 8, 4.3 for ν = 64. So a single pair of images hardly
    ever causes a charge.
    """
    variance = a.variance + b.variance
    pieces = a.variance**2 / a.freedom + b.variance**2 / b.freedom
    freedom = np.divide(variance**2, pieces, out=np.ones_like(variance), where=pieces > 0)
    z = SIGNIFICANT * (8 * freedom + 3) / (8 * freedom + 1)
    return np.asarray(freedom * np.expm1(z**2 / freedom) * variance)
