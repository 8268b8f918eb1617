"""Metrics of single images and their means, with 95 % confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.statistics import Estimate, group_means

NORMAL_975 = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


@dataclass(frozen=True, slots=True)
class PerImage:
    """A metric of each image."""

    estimate: Estimate  # over groups: the images of one group are not independent
    interval: tuple[float, float] | None  # 95 %, by Student's t; None for a single group
    values: tuple[float, ...]  # one for each image, in their order

    @classmethod
    def of(cls, values: NDArray[np.float64], groups: Sequence[Hashable] | None = None) -> PerImage:
        """The mean and interval of one value per image (N,); `groups` are independent, by default single images."""
        estimate = Estimate.of(values if groups is None else group_means(values, groups))
        return cls(estimate, confidence_interval(estimate), tuple(values.tolist()))


def confidence_interval(estimate: Estimate) -> tuple[float, float] | None:
    """The two-sided 95 % interval of an estimate's mean; None if the standard error is unknown."""
    if estimate.standard_error is None:
        return None
    reach = t_975(estimate.count - 1) * estimate.standard_error
    return estimate.mean - reach, estimate.mean + reach


def t_975(freedom: int) -> float:
    """The 97.5 % quantile of Student's t, within 0.2 % for every number of degrees of freedom ≥ 1.

    Closed forms for 1 and 2, the expansion in 1/ν above [Abramowitz and Stegun 26.7.5].
    """
    if freedom < 1:
        raise ValueError(f"freedom is {freedom}; Student's t has at least one degree of freedom")
    if freedom == 1:
        return math.tan(0.475 * math.pi)
    if freedom == 2:
        return 0.95 * math.sqrt(2 / (1 - 0.95**2))
    z = NORMAL_975
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / freedom ** (power + 1) for power, term in enumerate(terms))
