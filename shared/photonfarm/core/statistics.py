"""Statistics of independent noisy images: tests for equal means, and errors without a reference. Pure numpy.

*Tests.* Shapes: K, L numbers of independent renders, H, W image, C channels, B×B blocks. A block is the mean over its
pixels and channels; averaging comes before testing, since single pixels of Monte Carlo images are far from normally
distributed and blocks are less so.

*Errors.* Every sample carries two independent, unbiased half-estimates A and B of one clean image I [ours]. Their noise
is independent, so its product vanishes in expectation: what remains of a prediction's error is the error against I,
which is never rendered. Arrays are (..., H, W, 3); values are linear radiance (exposed or not), never clipped.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from photonfarm.core.records import F32

Array = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class BlockTest:
    """What a block z-test found."""

    z: npt.NDArray[np.float64]  # [B, B]: difference of the means over its standard error
    z_max: float  # largest |z|
    z_limit: float  # the largest |z| expected by chance with probability 1 − significance, over all blocks together
    mean_ratio: float  # mean of a over mean of b, whole images
    mean_ratio_standard_error: float
    finite: bool  # whether every value of every image is finite

    @property
    def passed(self) -> bool:
        """Whether no block differs by more than chance allows."""
        return self.finite and self.z_max < self.z_limit


def block_z_test(
    images_a: Array, images_b: Array, blocks: int = 16, significance: float = 0.001, floor: float = 1e-5
) -> BlockTest:
    """Welch's test for each block, with Šidák's correction for their number.

    ``images_a`` [K, H, W, C], ``images_b`` [L, H, W, C] with K, L ≥ 2; images smaller than ``blocks`` get one block
    per pixel. ``significance``: probability that any block of two equal sets fails. With few renders the statistic
    follows Student's t, not a normal distribution: each t is mapped to the normal z of the same tail probability, so
    ``z`` means the same for all K, L. ``floor``: standard error, relative to the larger of the block's and the images'
    mean, below which blocks count as equal: the rounding of float32 sums over some thousand samples. Raises ValueError
    for other shapes.
    """
    a, b = (np.asarray(x, dtype=np.float64) for x in (images_a, images_b))
    if a.ndim != 4 or b.ndim != 4 or a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
        raise ValueError(
            f"block_z_test: got shapes {a.shape} and {b.shape}; allowed are [K, H, W, C] and [L, H, W, C] with "
            "K, L ≥ 2, since the variance is estimated from the renders themselves"
        )
    means_a, means_b = block_means(a, blocks), block_means(b, blocks)
    squared_a, squared_b = means_a.var(axis=0, ddof=1) / len(a), means_b.var(axis=0, ddof=1) / len(b)
    squared = squared_a + squared_b
    difference = means_a.mean(axis=0) - means_b.mean(axis=0)
    overall = max(abs(float(a.mean())), abs(float(b.mean())), 1e-30)
    smallest = floor * np.maximum(np.maximum(np.abs(means_a).max(axis=0), np.abs(means_b).max(axis=0)), overall)
    t = difference / np.maximum(np.sqrt(squared), smallest)
    # Welch–Satterthwaite degrees of freedom
    pieces = squared_a**2 / (len(a) - 1) + squared_b**2 / (len(b) - 1)
    freedom = np.divide(squared**2, pieces, out=np.full_like(squared, len(a) + len(b) - 2.0), where=pieces > 0)
    z = student_to_normal(t, freedom)
    ratio, error = mean_ratio(a, b)
    finite = bool(np.isfinite(a).all() and np.isfinite(b).all())
    limit = two_sided_limit(1 - (1 - significance) ** (1 / z.size))
    return BlockTest(z, float(np.abs(z).max()), limit, ratio, error, finite)


def block_means(images: Array, blocks: int) -> npt.NDArray[np.float64]:
    """[K, B, B] means over blocks of pixels, and over channels; edges are spread as evenly as pixels allow."""
    luminance = np.asarray(images, dtype=np.float64).mean(axis=-1)
    rows = np.linspace(0, luminance.shape[1], min(blocks, luminance.shape[1]) + 1).astype(int)
    columns = np.linspace(0, luminance.shape[2], min(blocks, luminance.shape[2]) + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(luminance, rows[:-1], axis=1), columns[:-1], axis=2)
    return sums / (np.diff(rows)[:, None] * np.diff(columns)[None, :])


def mean_ratio(images_a: Array, images_b: Array) -> tuple[float, float]:
    """(mean of a over mean of b, its standard error) over whole images, by the delta method; NaN where b is black."""
    a, b = (np.asarray(x, dtype=np.float64).reshape(len(x), -1).mean(axis=1) for x in (images_a, images_b))
    if b.mean() == 0:
        return float("nan"), float("nan")
    ratio = a.mean() / b.mean()
    relative = np.sqrt(a.var(ddof=1) / len(a) / max(a.mean() ** 2, 1e-60) + b.var(ddof=1) / len(b) / b.mean() ** 2)
    return float(ratio), float(abs(ratio) * relative)


def two_sided_limit(probability: float) -> float:
    """The z that a standard normal variable exceeds in absolute value with this probability."""
    return -NormalDist().inv_cdf(probability / 2)


def student_to_normal(t: Array, freedom: Array) -> npt.NDArray[np.float64]:
    """z of about the same tail probability as Student's t (Wallace, *Bounds on normal approximations*, 1959, eq. 5)."""
    t, freedom = np.asarray(t, dtype=np.float64), np.asarray(freedom, dtype=np.float64)
    magnitude = (8 * freedom + 1) / (8 * freedom + 3) * np.sqrt(freedom * np.log1p(t**2 / freedom))
    return np.sign(t) * magnitude


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean and its standard error, from `count` independent samples; `group_means` makes dependent ones so."""

    mean: float
    standard_error: float | None  # None from a single sample
    count: int

    @classmethod
    def of(cls, per_sample: NDArray[np.float64]) -> Estimate:
        """Mean and s/√n of one number per sample; s has n − 1 degrees of freedom."""
        count = len(per_sample)
        if count == 0:
            raise ValueError("per_sample is empty; an estimate needs at least one sample")
        error = float(np.std(per_sample, ddof=1) / np.sqrt(count)) if count > 1 else None
        return cls(float(np.mean(per_sample)), error, count)

    @property
    def interval(self) -> tuple[float, float] | None:
        """Where the mean lies with probability 0.95, by Student's t; None without a standard error.

        It is Wallace's bound of `student_to_normal`, solved for t.
        """
        if self.standard_error is None:
            return None
        freedom, z = self.count - 1, -NormalDist().inv_cdf(0.025)
        t = np.sqrt(freedom * np.expm1((z * (8 * freedom + 3) / (8 * freedom + 1)) ** 2 / freedom))
        return self.mean - float(t) * self.standard_error, self.mean + float(t) * self.standard_error


def jackknife(value: float, without: NDArray[np.float64], weights: NDArray[np.integer]) -> Estimate:
    """An estimate from all parts, with the standard error that follows from leaving out one part after another (N,).

    Parts may weigh differently (Busing, Meijer and van der Leeden, *Delete-m jackknife for unequal m*, 1999, eq. 8).
    """
    h = weights.sum() / weights
    pseudo = h * value - (h - 1) * without
    centre = len(h) * value - float(((1 - 1 / h) * without).sum())
    return Estimate(value, float(np.sqrt(np.mean((pseudo - centre) ** 2 / (h - 1)))), len(h))


def format_estimate(mean: float, standard_error: float | None) -> str:
    """An estimate in words: "0.12345 ± 0.00678", without the error if it is None; large numbers get few digits."""
    values = [mean] if standard_error is None else [mean, standard_error]
    return " ± ".join(f"{value:.5f}" if abs(value) < 1e5 else f"{value:.3g}" for value in values)


def group_means(values: NDArray[np.float64], groups: Sequence[Hashable]) -> NDArray[np.float64]:
    """The mean value of each group, in order of first appearance; `groups` names the group of each value."""
    place = {group: i for i, group in enumerate(dict.fromkeys(groups))}
    of_value = np.array([place[group] for group in groups], np.int64)
    return np.bincount(of_value, weights=values) / np.bincount(of_value)


def clean_error(prediction: F32, half_a: F32, half_b: F32) -> float:
    """Unbiased mean squared error against the clean image: mean (f − A)(f − B).

    E[(f−A)(f−B)] = (f−I)² for A and B independent with mean I; it may be negative where the error is below the noise.
    f must not have seen A or B: fixed, it leaves the expectation of a product of independent factors.
    """
    return float(np.mean((prediction.astype(np.float64) - half_a) * (prediction.astype(np.float64) - half_b)))


def clean_error_having_seen_a(prediction: F32, half_a: F32, half_b: F32) -> float:
    """Unbiased mean squared error against the clean image of a prediction that was made from A: mean f² − 2fB + AB.

    f and A both are independent of B, and so E[fB] = E[f] I and E[AB] = I². No square of a noisy value enters.
    """
    f, a, b = (image.astype(np.float64) for image in (prediction, half_a, half_b))
    return float(np.mean(f * (f - 2 * b) + a * b))


def noise_floor(half_a: F32, half_b: F32) -> float:
    """The variance of the target (A + B)/2, averaged over pixels: mean (A − B)² / 4.

    E[(A−B)²] = var A + var B = 4 var((A+B)/2). Adding it to `clean_error` gives the error against the noisy target.
    """
    return float(np.mean((half_a.astype(np.float64) - half_b) ** 2) / 4)
