"""The settings of `bdpt` that compete, and how much sooner one reaches the error of another."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.models import Frozen
from photonfarm.core.records import F32
from photonfarm.scene.spec import SceneSpec

CLEAR = 2.0
"""The standard errors by which two candidates must differ to be distinguished."""

WORTHWHILE = 0.05
"""The least gain that changes settings."""


@dataclass(frozen=True, slots=True, order=True)
class Candidate:
    """Settings of `bdpt`; all candidates have the same mean."""

    connections: int  # light vertices joined to each of the first two eye vertices
    light_ratio: float  # light paths per eye path; 0: plain path tracing
    guided_light: bool = False  # whether a guide says where light paths start and connections go
    light_samples: int = 1  # of next event estimation at the first eye vertex

    def __str__(self) -> str:
        few = {0: "without connections", 1: "with 1 connection"}
        joined = few.get(self.connections, f"with {self.connections} connections")
        walks = f"light ratio {self.light_ratio:g} {joined}" if self.light_ratio else "plain path tracing"
        samples = f", {self.light_samples} light samples" if self.light_samples > 1 else ""
        return walks + ", guided light" * self.guided_light + samples


PLAIN = Candidate(0, 0.0)
"""Plain path tracing with next event estimation: the baseline of all comparisons."""

DEFAULT = Candidate(1, 1.0)
"""The settings of a spec that states none."""

GRID = (
    PLAIN,
    Candidate(4, 0.125, True),
    Candidate(2, 0.25, light_samples=4),
    Candidate(0, 1.0, True),
    Candidate(8, 0.0625, True),
    Candidate(4, 0.125, light_samples=2),
    Candidate(2, 0.25),
    Candidate(2, 0.25, True, light_samples=2),
    Candidate(0, 16.0, True),
    Candidate(4, 0.125),
    Candidate(2, 0.25, light_samples=2),
    Candidate(2, 0.25, True),
    Candidate(1, 1.0),
    *(Candidate(0, ratio) for ratio in (0.25, 1.0, 4.0, 16.0)),
)
"""The candidates of every pilot, except those that a scene's content makes pointless.

Where there is no time for all, only the first are compared. So the most useful come first: guided light paths with
connections for indirect light, several light samples for evenly lit rooms, guided splats alone for caustics.

A light ratio above 1 helps only with light that splats alone find. Connections need few light paths, as several eye
paths may be joined to the same one. Several light samples pay where direct light at the first eye vertex has much of
the noise, as in evenly lit rooms.
"""

Render: TypeAlias = Callable[[Candidate, int, int], F32]
"""(candidate, seed, samples per pixel) → one unbiased noisy image (H, W, 3) of one configuration and view."""


def present(spec: SceneSpec) -> Candidate:
    """The present settings of a spec."""
    t = spec.transport
    return Candidate(t.connections, t.light_ratio, t.guided_light, t.light_samples)


class RelativeErrors(Frozen):
    """A candidate's error of one image, with the charge for missed light, by views, or by pairs of a single view.

    `plain` has the same values of plain path tracing, over images of the same seeds. Both have the same rare bright
    samples, so their ratio is more certain than either of them.
    """

    images: int  # number of rendered images, over all views
    own: tuple[float, ...]
    plain: tuple[float, ...]

    @property
    def mean(self) -> float:
        """The error of one image."""
        return _mean(self.own)

    @property
    def ratio(self) -> float:
        """The error of one image over that of plain path tracing."""
        return self.mean / _mean(self.plain)

    def relative_spread(self, other: RelativeErrors) -> float | None:
        """The relative standard error of one candidate's `ratio` over another's; None from a single value each.

        It is the standard error of a ratio of means (Cochran, *Sampling Techniques*, 6.5), taken over views. So it
        contains the noise and the choice of views; the error of measured times is negligible. If both candidates have
        the same number of images, the errors of plain path tracing cancel. Otherwise the two ratios are taken as
        independent, which overstates the result.
        """
        if self.images == other.images:
            return _standard_error(_scale(self.own) - _scale(other.own))
        parts = [_standard_error(_scale(errors.own) - _scale(errors.plain)) for errors in (self, other)]
        return None if parts[0] is None or parts[1] is None else math.hypot(parts[0], parts[1])


def _mean(errors: Sequence[float]) -> float:
    return max(float(np.mean(errors)), 1e-30)


def _scale(errors: Sequence[float]) -> NDArray[np.float64]:
    return np.array(errors, np.float64) / _mean(errors)


def _standard_error(residuals: NDArray[np.float64]) -> float | None:
    n = len(residuals)
    return float(np.sqrt(np.sum(residuals**2) / (n * (n - 1)))) if n > 1 else None


@dataclass(frozen=True, slots=True)
class MeasuredCandidate:
    """The measurement of one candidate."""

    candidate: Candidate
    errors: RelativeErrors
    missed: float  # the part of the error inferred from light that other candidates found (see `noise.missed`)
    time_s: float  # CPU time of one image
    relative_cost: float  # error × time over that of plain path tracing: the time to the same error
    spread: float | None  # standard error of relative_cost; None from a single pair of images

    @property
    def error(self) -> float:
        """The error of one image of the pilot: relMSE, or relative loss (see `noise`)."""
        return self.errors.mean


@dataclass(frozen=True, slots=True)
class Saving:
    """How much sooner one candidate reaches the error of another."""

    over: Candidate
    factor: float  # the other's time over this one's, to equal error
    spread: float | None  # its standard error

    @property
    def deviations(self) -> float:
        """log(factor) in standard errors, so that a factor and its inverse differ only in sign; 0 if unknown."""
        if self.spread is None:
            return 0.0
        return math.log(self.factor) / max(self.spread / self.factor, 1e-9)

    @property
    def significant(self) -> bool:
        """Whether the saving is worth a change of settings."""
        return self.factor >= 1 + WORTHWHILE and self.deviations >= CLEAR


def saving(one: MeasuredCandidate, over: MeasuredCandidate) -> Saving:
    """The saving of one candidate over another, from the errors and times of both."""
    factor = over.relative_cost / one.relative_cost
    relative = over.errors.relative_spread(one.errors)
    return Saving(over.candidate, factor, None if relative is None else factor * relative)


def is_alike(one: MeasuredCandidate, other: MeasuredCandidate) -> bool:
    """Whether the difference of two candidates is not significant."""
    return abs(saving(one, other).deviations) < CLEAR
