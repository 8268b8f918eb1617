"""What is concluded from errors at several budgets: by what factor one must grow; bias and noise of targets.

Nothing here renders or trains.

Shape letters: A arms, N views, H W image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.harness.network_errors import F64, Errors, replicates, within
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.trainer.training.losses import RELATIVE_EPSILON


@dataclass(frozen=True, slots=True)
class BudgetFactor:
    """A factor and its 95 % interval; 0 is less than was tried, infinity more."""

    value: float
    low: float
    high: float


def crossing(budgets: Sequence[float], errors: Sequence[float] | F64, wanted: float) -> float:
    """The first budget at which errors, linear in its logarithm between arms, come down to what is wanted.

    Budgets ascend, (A,) like the errors. 0 if the smallest is enough, infinity if none is.
    """
    if errors[0] <= wanted:
        return 0.0
    for place in range(1, len(budgets)):
        if errors[place] <= wanted:
            share = (errors[place - 1] - wanted) / (errors[place - 1] - errors[place])
            return float(budgets[place - 1] * (budgets[place] / budgets[place - 1]) ** share)
    return math.inf


def factor(wanted: Errors, arms: Sequence[Errors], budgets: Sequence[float], spread: float) -> BudgetFactor:
    """The budget at which arms come down to the errors that are wanted, with its bootstrap interval.

    `spread` is what seeds move an arm's mean by, as `replicates` has it.
    """
    value = crossing(budgets, [arm.estimate().mean for arm in arms], wanted.estimate().mean)
    found = [crossing(budgets, one[1:], one[0]) for one in replicates([wanted, *arms], spread=spread)]
    return BudgetFactor(value, *within(np.array(found)))


def factors_of_seeds(wanted: Errors, arms: Sequence[Errors], budgets: Sequence[float]) -> list[float]:
    """The budget that `factor` finds, for each seed alone."""
    means = np.stack([one.of_seeds() for one in (wanted, *arms)])
    return [crossing(budgets, of_seed[1:], of_seed[0]) for of_seed in means.T]


def ratio(above: F64, below: F64, units: Sequence[Key]) -> BudgetFactor:
    """The ratio of two means over views (N,), with its bootstrap interval over configurations."""
    errors = [Errors(values[None], tuple(units)) for values in (above, below)]
    drawn = replicates(errors)
    low, high = within(drawn[:, 0] / drawn[:, 1])
    return BudgetFactor(errors[0].estimate().mean / errors[1].estimate().mean, low, high)


# ------------------------------------------------------------------------------------------------------------ targets


@dataclass(frozen=True, slots=True)
class Bias:
    """Whether two kinds of targets have the same mean."""

    ratio: float
    standard_error: float

    @property
    def z(self) -> float:
        """Standard errors that the ratio is off 1."""
        return (self.ratio - 1) / self.standard_error


def bias(ours: F32, theirs: F32) -> tuple[Bias, Bias]:
    """The mean of their targets over that of ours, of halves (N, 2, H, W, 3) of the same views.

    First of all light, where bright views count most; then 1 + the mean of 2 (theirs − ours) / (theirs + ours) of
    each view, where all count alike. Both are of differences on one view: what it is like drops out of the errors.
    """
    a, b = (halves.mean(axis=(1, 2, 3, 4), dtype=np.float64) for halves in (ours, theirs))
    all_light = b.mean() / a.mean()
    error = np.std(b - all_light * a, ddof=1) / (math.sqrt(len(a)) * a.mean())
    apart = 2 * (b - a) / (b + a)
    alike = Bias(float(1 + apart.mean()), float(np.std(apart, ddof=1) / math.sqrt(len(a))))
    return Bias(float(all_light), float(error)), alike


def noise(halves: F32) -> F64:
    """Variance of the target (A + B)/2 of each view, mean over pixels, of halves (N, 2, H, W, 3): (N,).

    From their difference, mean (A − B)² / 4, so that it is not biased.
    """
    squared = (halves[:, 0] - halves[:, 1]).astype(np.float64) ** 2
    return np.asarray(squared.mean(axis=(1, 2, 3)) / 4)


def relative_noise(halves: F32, clean: F32) -> F64:
    """The same as training counts it: over I² + ε of the clean image's brightness I, of (N, H, W, 3); (N,)."""
    squared = (halves[:, 0] - halves[:, 1]).astype(np.float64) ** 2
    brightness = clean.astype(np.float64).mean(axis=-1, keepdims=True)
    return np.asarray((squared / (brightness**2 + RELATIVE_EPSILON)).mean(axis=(1, 2, 3)) / 4)
