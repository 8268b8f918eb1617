"""Distances between two sets of images, as sets of Inception features: FID and KID.

Shape letters: N images, D features (2048), R rank.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.statistics import Estimate

FULL_RANK = 2048
"""The least number of images with which FID can be compared with published figures [method §4]."""
FEWEST = 3
"""The least number of images for which a U-statistic of pairs has a jackknife."""
ROWS = 1024  # of the kernel matrix at a time

_F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fid:
    """A Fréchet Inception distance, and the numbers of images: the fewer, the larger it is, whatever they show."""

    value: float
    predictions: int
    references: int
    warning: str | None  # if the count is too low to compare with published figures


def fid(predictions: NDArray[np.floating], references: NDArray[np.floating]) -> Fid:
    """The Fréchet distance of the normal distributions fitted to pool3 features, (N, D) and (M, D).

    [Heusel et al., 2017]: |μ − ν|² + tr Σ + tr T − 2 tr (ΣT)^½ with unbiased covariances, in float64. With Σ = FᵀF
    and T = GᵀG the square roots of ΣT's eigenvalues are the singular values of FGᵀ: so no root of a singular matrix is
    ever taken. Raises ValueError below two images.
    """
    (mean_a, factor_a), (mean_b, factor_b) = _fit_normal(predictions), _fit_normal(references)
    overlap = np.linalg.svd(factor_a @ factor_b.T, compute_uv=False).sum()
    spread = np.sum(factor_a**2) + np.sum(factor_b**2)
    distance = float(np.sum((mean_a - mean_b) ** 2) + spread - 2 * overlap)
    counts = len(predictions), len(references)
    return Fid(max(distance, 0.0), *counts, _warn_of_few(min(counts)))  # below 0 only by rounding


def _fit_normal(features: NDArray[np.floating]) -> tuple[_F64, _F64]:
    """Mean (D,) and a factor F (R, D) of the unbiased covariance FᵀF, R = min(N, D)."""
    count, width = features.shape
    if count < 2:
        raise ValueError(f"there is {count} image; a covariance, and so FID, needs at least two")
    values = features.astype(np.float64)
    mean: _F64 = values.mean(axis=0)
    factor = (values - mean) / np.sqrt(count - 1)
    if count > width:
        factor = np.asarray(np.linalg.qr(factor, mode="r"))
    return mean, factor


def _warn_of_few(count: int) -> str | None:
    if count >= FULL_RANK:
        return None
    return (
        f"FID of {count} images: below {FULL_RANK} its covariance is singular and FID comes out larger than of more "
        "images; compare it only with FID of as many, or look at KID"
    )


def kid(predictions: NDArray[np.floating], references: NDArray[np.floating]) -> Estimate:
    """Unbiased squared MMD of pool3 features, (N, D) each, with k(x, y) = (x·y/D + 1)³ [Bińkowski et al., 2018].

    The mean over i ≠ j of k(xᵢ, xⱼ) + k(yᵢ, yⱼ) − k(xᵢ, yⱼ) − k(xⱼ, yᵢ) [Gretton et al., 2012, eq. 4]: over all
    images rather than subsets of them. Image i of both sets shows the same view, so k(xᵢ, yᵢ) is left out: it would
    bias the value down. As it is unbiased, it may be negative. The standard error is the jackknife's, over views.
    Raises ValueError for sets of different sizes, or below three images.
    """
    count = len(predictions)
    if predictions.shape != references.shape or count < FEWEST:
        shapes = f"{predictions.shape} and {references.shape}"
        raise ValueError(f"features have the shapes {shapes}; KID needs two equal ones, of at least {FEWEST} images")
    x, y = predictions.astype(np.float64), references.astype(np.float64)
    sums = np.concatenate([_sum_pairs(x, y, start) for start in range(0, count, ROWS)])
    value = sums.sum() / (count * (count - 1))
    without = (sums.sum() - 2 * sums) / ((count - 1) * (count - 2))
    variance = (count - 1) / count * np.sum((without - without.mean()) ** 2)
    return Estimate(float(value), float(np.sqrt(variance)), count)


def _sum_pairs(x: _F64, y: _F64, start: int) -> _F64:
    """The sum over j ≠ i of the U-statistic's kernel for each image i from `start` on, (≤ ROWS,)."""
    row = slice(start, start + ROWS)
    pairs = _kernel(x[row], x) + _kernel(y[row], y) - _kernel(x[row], y) - _kernel(y[row], x)
    itself = pairs[np.arange(len(pairs)), start + np.arange(len(pairs))]
    return pairs.sum(axis=1) - itself


def _kernel(x: _F64, y: _F64) -> _F64:
    kernel: _F64 = (x @ y.T / x.shape[1] + 1) ** 3
    return kernel
