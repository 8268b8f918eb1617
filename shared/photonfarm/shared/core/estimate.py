"""Unbiased errors of a prediction against noisy targets: the targets' noise adds nothing in expectation.

Every sample carries two independent, unbiased half-estimates A and B of one clean image I [ours]. Their noise is
independent, so its product vanishes in expectation: what remains is the error against I, which is never rendered.
Arrays are (..., H, W, 3); values are linear radiance (exposed or not), never clipped.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.records import F32


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


def stated(mean: float, standard_error: float | None) -> str:
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
