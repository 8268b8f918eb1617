"""Errors of images that networks made of held-out views, their intervals, and a bootstrap of several together.

Shape letters: A arms, N views, R replicates of a bootstrap, S seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.metrics.image_metrics import t_975

F64 = NDArray[np.float64]

REPLICATES = 4000
LEVELS = (0.025, 0.975)


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of images that networks of one kind made, one from each seed, and what is concluded from them; S seeds."""

    values: NDArray[np.float64]  # (S, N)
    units: tuple[Key, ...]  # what each view's configuration is: views of one are not independent

    def less(self, other: Errors) -> Errors:
        """Differences from the same seeds on the same views."""
        return Errors(self.values - other.values, self.units)

    def of_views(self) -> NDArray[np.float64]:
        """Means over seeds, (N,)."""
        means: NDArray[np.float64] = self.values.mean(axis=0)
        return means

    def of_seeds(self) -> NDArray[np.float64]:
        """Means over configurations, (S,)."""
        return np.array([group_means(values, self.units).mean() for values in self.values])

    def estimate(self) -> Estimate:
        """Mean and standard error, se² = se²(configurations) + var(seeds) / S.

        The first is of means over seeds. From one seed there is no second: it is of this network then.
        """
        over_units, over_seeds = self._parts()
        if over_units.standard_error is None or over_seeds.standard_error is None:
            return over_units
        error = math.hypot(over_units.standard_error, over_seeds.standard_error)
        return Estimate(over_units.mean, error, over_units.count)

    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the mean; raises ValueError where one configuration is all there is.

        By Student's t with Satterthwaite's degrees of freedom, se⁴ / Σ seᵢ⁴ / νᵢ [Satterthwaite 1946], rounded down:
        where the seeds' variance leads, little is known of it.
        """
        found = self.estimate()
        if found.standard_error is None:
            raise ValueError("an interval needs two configurations at least")
        known = [(part.standard_error, part.count - 1) for part in self._parts() if part.standard_error]
        apart = sum(error**4 / freedom for error, freedom in known)
        reach = t_975(int(found.standard_error**4 / apart + 1e-9)) * found.standard_error if apart else 0.0
        return found.mean - reach, found.mean + reach

    def _parts(self) -> tuple[Estimate, Estimate]:
        """The estimates over configurations, and over seeds."""
        return Estimate.of(group_means(self.of_views(), self.units)), Estimate.of(self.of_seeds())


def stated(errors: Errors, digits: int = 5) -> str:
    """Mean and 95 % interval."""
    low, high = errors.interval()
    return f"{errors.estimate().mean:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})"


def each_seed(errors: Errors, form: str = ".5f") -> str:
    """The mean of each seed."""
    return " · ".join(f"{mean:{form}}" for mean in errors.of_seeds())


def of_intervals(seeds: int) -> str:
    """The sentence of a page about its intervals."""
    if seeds == 1:
        return "Intervals are over configurations, for these networks: those of another seed may lie outside."
    return (
        f"Intervals are for networks of any seed: se² = se²(configurations) + var(seeds) / {seeds}, the first after "
        "the mean over seeds; Student's t with Satterthwaite's degrees of freedom."
    )


# ---------------------------------------------------------------------------------------------------------- bootstrap


def seed_spread(arms: Sequence[Errors]) -> float:
    """Standard deviation of a seed's mean error as a share of its arm's, pooled over arms; 0 from one seed."""
    seeds = len(arms[0].values)
    if seeds == 1:
        return 0.0
    apart = [(means := arm.of_seeds()) / means.mean() - 1 for arm in arms]
    return math.sqrt(sum(float(np.sum(one**2)) for one in apart) / (len(arms) * (seeds - 1)))


def replicates(arms: Sequence[Errors], count: int = REPLICATES, seed: int = 0, *, spread: float | None = None) -> F64:
    """Mean errors of each arm as other configurations and seeds might have given them, (R, A).

    Configurations are drawn with replacement, the same for all arms. Two seeds are too few to draw from: each arm's
    mean is moved by a normal deviate instead, of `spread` / √S: `seed_spread` of these arms unless another is given.
    """
    rng = np.random.default_rng(seed)
    of_units = np.stack([group_means(arm.of_views(), arm.units) for arm in arms])
    units = of_units.shape[1]
    means = rng.multinomial(units, np.full(units, 1 / units), size=count) @ of_units.T / units
    spread = seed_spread(arms) if spread is None else spread
    moved: F64 = means * (1 + spread / math.sqrt(len(arms[0].values)) * rng.normal(size=means.shape))
    return moved


def own_errors(arms: Sequence[Errors]) -> F64:
    """Standard errors of the arms' means, (A,), without what the arms of a room have in common.

    How hard a configuration is, as a share of an arm's mean and the same for all, is taken out: it moves all arms
    together. What seeds move is pooled as in `seed_spread`.
    """
    of_units = np.stack([group_means(arm.of_views(), arm.units) for arm in arms])
    means = of_units.mean(axis=1)
    shares = of_units / means[:, None]
    apart = (shares - shares.mean(axis=0)).var(axis=1, ddof=1) / of_units.shape[1]
    whole = apart * len(arms) / (len(arms) - 1)  # an arm is part of the mean that is taken out of it
    found: F64 = means * np.sqrt(whole + seed_spread(arms) ** 2 / len(arms[0].values))
    return found


def within(replicated: F64) -> tuple[float, float]:
    """The 95 % interval of replicates (R,), by values that occur: nothing lies between a number and infinity."""
    low, high = np.quantile(replicated, LEVELS, method="closest_observation")
    return float(low), float(high)
