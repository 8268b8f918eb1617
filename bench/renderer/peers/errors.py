"""Errors of images against a noisy reference, and their uncertainty. Pure numpy.

Shapes: K independent renders, H, W image, P = H·W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
EPSILON = 1e-2  # so that dark pixels do not count without bound; as in the pilot (renderer/strategy/noise.py)
TRIM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceImage:
    """An estimate of the true image that shares no sample with what is measured against it."""

    image: F64  # [H, W, 3]
    variance: F64  # [H, W, 3]: of `image`, not of one render
    mean: float
    mean_standard_error: float


def reference_of(sets: list[Any]) -> ReferenceImage:
    """The mean of sets of independent renders [K, H, W, 3], each weighted by the inverse variance of its mean.

    One weight per set, not per pixel: weights that follow a pixel's own noise would favour renders that missed light.
    """
    stacks = [np.asarray(images, dtype=np.float64) for images in sets]
    variances = [images.var(axis=0, ddof=1) / len(images) for images in stacks]
    weights = np.array([1 / max(float(v.mean()), 1e-30) for v in variances])
    weights /= weights.sum()
    image = sum(w * s.mean(axis=0) for w, s in zip(weights, stacks, strict=True))
    variance = sum(w**2 * v for w, v in zip(weights, variances, strict=True))
    means = [s.reshape(len(s), -1).mean(axis=1) for s in stacks]
    squared = sum(w**2 * m.var(ddof=1) / len(m) for w, m in zip(weights, means, strict=True))
    return ReferenceImage(np.asarray(image), np.asarray(variance), float(np.mean(image)), math.sqrt(float(squared)))


def relative_errors(images: Any, reference: ReferenceImage, relative_to: ReferenceImage | None = None) -> F64:
    """[K, P] squared errors ((f − r)² − var r) / (q² + ε·mean(q)²), averaged over channels; q is r unless given.

    f and r are independent, so E (f − r)² = E (f − truth)² + var r: subtracting the reference's variance leaves the
    error against the truth, bias included. Single values can be negative. Noise of q makes dark pixels count somewhat
    too much; with one q for all methods this drops out of their ratios.
    """
    f, q = np.asarray(images, dtype=np.float64), relative_to or reference
    squared = (f - reference.image) ** 2 - reference.variance
    return np.asarray((squared / (q.image**2 + EPSILON * q.mean**2)).mean(axis=-1).reshape(len(f), -1))


def full_error(errors: F64) -> float:
    """RelMSE: mean of [K, P] errors."""
    return float(errors.mean())


def trimmed_error(errors: F64) -> float:
    """RelMSE without the pixels whose error, averaged over the renders, is among the worst 1 %.

    The same rule for every method, but each loses its own worst pixels. It forgives rare outliers, so it flatters
    methods that have them; what it says is how the rest of the image looks.
    """
    pixels = np.sort(errors.mean(axis=0))
    return float(pixels[: max(1, round(pixels.size * (1 - TRIM)))].mean())


@dataclass(frozen=True, slots=True)
class JackknifeEstimate:
    """A figure and its standard error; NaN where it cannot be had."""

    value: float
    standard_error: float


def jackknifed(estimate: Callable[[NDArray[np.intp]], float], rounds: int) -> JackknifeEstimate:
    """`estimate` of all round numbers, with the delete-one jackknife's standard error.

    Works on logarithms, as errors and their ratios are products. NaN if any estimate is not positive.
    """
    everything = np.arange(rounds)
    whole = estimate(everything)
    parts = np.array([estimate(np.delete(everything, k)) for k in range(rounds)]) if rounds > 2 else np.array([np.nan])
    if not whole > 0 or not np.all(parts > 0):
        return JackknifeEstimate(whole if whole > 0 else math.nan, math.nan)
    logarithms = np.log(parts)
    spread = math.sqrt((rounds - 1) / rounds * float(((logarithms - logarithms.mean()) ** 2).sum()))
    return JackknifeEstimate(whole, whole * spread)


def error_of(errors: F64, measure: Callable[[F64], float]) -> JackknifeEstimate:
    """One figure of [K, P] errors, full or trimmed, and its standard error."""
    return jackknifed(lambda kept: measure(errors[kept]), len(errors))


def efficiency(
    errors: F64, seconds: F64, base_errors: F64, base_seconds: F64, measure: Callable[[F64], float]
) -> JackknifeEstimate:
    """(error × time) of the baseline over that of a method, above 1 is better.

    Errors [K, P], seconds [K]; round k of both ran one after the other, and they are deleted together.
    """

    def ratio(kept: NDArray[np.intp]) -> float:
        cost = measure(errors[kept]) * seconds[kept].mean()
        return float(measure(base_errors[kept]) * base_seconds[kept].mean() / cost) if cost else math.nan

    return jackknifed(ratio, len(errors))


@dataclass(frozen=True, slots=True)
class MeanRatio:
    """Mean of a method's images over that of the reference."""

    value: float
    standard_error: float
    z: float  # (value − 1) in standard errors, mapped from Student's t to a normal distribution


def mean_ratio(images: Any, reference: ReferenceImage) -> MeanRatio:
    """How bright K images are together, against the reference; its noise counts too."""
    from photonfarm.core.statistics import student_to_normal

    means = np.asarray(images, dtype=np.float64).reshape(len(images), -1).mean(axis=1)
    own, base = means.var(ddof=1) / len(means), reference.mean_standard_error**2
    ratio = means.mean() / reference.mean
    error = math.sqrt(own + ratio**2 * base) / reference.mean
    z = student_to_normal(np.array([(ratio - 1) / max(error, 1e-6)]), np.array([float(len(means) - 1)]))
    return MeanRatio(float(ratio), error, float(z[0]))
