"""How much sooner one candidate reaches the error of another, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.strategy.candidate import Candidate
from photonfarm.shared.scene.spec import Frozen

CLEAR = 2.0
"""Standard errors by which two candidates must differ to be told apart."""

WORTHWHILE = 0.05
"""Least gain for which settings are changed: a changed scene has another id, so all its samples are rendered again."""


class Errors(Frozen):
    """relMSE of one image of a candidate by views, with what is inferred as missed; of a single view, by pairs.

    Beside it that of plain path tracing over the images of the same seeds: both have the same rare bright samples, so
    that their ratio is known better than either.
    """

    images: int  # rendered, over all views
    own: tuple[float, ...]
    plain: tuple[float, ...]

    @property
    def mean(self) -> float:
        """relMSE of one image."""
        return _mean(self.own)

    @property
    def ratio(self) -> float:
        """That of one image over plain path tracing's."""
        return self.mean / _mean(self.plain)

    def relative_spread(self, other: Errors) -> float | None:
        """Standard error of the ratio of two candidates' ratios, over itself; None of a single value each.

        It is that of a ratio of means (Cochran, *Sampling Techniques*, 6.5), over views: so it holds what the noise and
        what the choice of views contribute; that of the times is next to nothing. Of equally many images plain path
        tracing's cancel; otherwise the two ratios are taken as independent, which overstates it.
        """
        if self.images == other.images:
            return _standard_error(_scaled(self.own) - _scaled(other.own))
        parts = [_standard_error(_scaled(errors.own) - _scaled(errors.plain)) for errors in (self, other)]
        return None if parts[0] is None or parts[1] is None else math.hypot(parts[0], parts[1])


def _mean(errors: Sequence[float]) -> float:
    return max(float(np.mean(errors)), 1e-30)


def _scaled(errors: Sequence[float]) -> NDArray[np.float64]:
    return np.array(errors, np.float64) / _mean(errors)


def _standard_error(residuals: NDArray[np.float64]) -> float | None:
    n = len(residuals)
    return float(np.sqrt(np.sum(residuals**2) / (n * (n - 1)))) if n > 1 else None


@dataclass(frozen=True, slots=True)
class Measured:
    """What is known of one candidate."""

    candidate: Candidate
    errors: Errors
    missed: float  # the part of the error that was not seen, but inferred from light that others found (see `noise`)
    time_s: float  # CPU time of one image
    relative_cost: float  # error × time over that of plain path tracing: the time to the same error
    spread: float | None  # standard error of relative_cost; None of a single pair of images

    @property
    def error(self) -> float:
        """relMSE of one image of the pilot."""
        return self.errors.mean


@dataclass(frozen=True, slots=True)
class Saving:
    """How much sooner one candidate reaches the error of another."""

    over: Candidate
    factor: float  # time of the other over that of the one, to equal error
    spread: float | None  # its standard error

    @property
    def deviations(self) -> float:
        """Standard errors of log(factor) above 0, which treats a ratio and its inverse alike; 0 where none is known."""
        if self.spread is None:
            return 0.0
        return math.log(self.factor) / max(self.spread / self.factor, 1e-9)

    @property
    def significant(self) -> bool:
        """Whether it is worth a change of settings."""
        return self.factor >= 1 + WORTHWHILE and self.deviations >= CLEAR


def saving(one: Measured, over: Measured) -> Saving:
    """Of one candidate over another, both at their cost."""
    factor = over.relative_cost / one.relative_cost
    relative = over.errors.relative_spread(one.errors)
    return Saving(over.candidate, factor, None if relative is None else factor * relative)


def is_alike(one: Measured, other: Measured) -> bool:
    """Whether two candidates cannot be told apart."""
    return abs(saving(one, other).deviations) < CLEAR
