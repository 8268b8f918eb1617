"""The settings of `bdpt` that compete, what was measured of them, and how much sooner one reaches another's error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from photonfarm.core.models import Frozen
from photonfarm.core.records import F32
from photonfarm.scene.spec import SceneSpec

CLEAR = 2.0
"""The standard errors by which two candidates must differ to be distinguished."""

WORTHWHILE = 0.05
"""The least gain that changes settings."""

LEAST_SAMPLES = 0.7
"""The least samples per pixel that a time must pay for: rounded to 1 they cost 1.4 times as much at most."""

MOST_SAMPLES = 65536
"""The largest number of samples per pixel in a spec."""


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


def present_settings(spec: SceneSpec) -> Candidate:
    """The present settings of a spec."""
    t = spec.transport
    return Candidate(t.connections, t.light_ratio, t.guided_light, t.light_samples)


# ------------------------------------------------------------------------------------------------------- measurements


@dataclass(frozen=True, slots=True)
class ImageCost:
    """The CPU time of an image: a fixed part, and a part for each sample per pixel."""

    fixed_s: float
    sample_s: float

    @classmethod
    def through(cls, few: int, few_s: float, many: int, many_s: float) -> ImageCost:
        """The cost as a line through the times at two numbers of samples per pixel."""
        sample_s = max((many_s - few_s) / (many - few), 0.02 * few_s / few)  # if noise hides it
        return cls(max(few_s - few * sample_s, 0.0), sample_s)

    def time_s(self, spp: float) -> float:
        """The time of an image with `spp` samples per pixel."""
        return self.fixed_s + spp * self.sample_s

    def pays(self, seconds: float) -> bool:
        """Whether a time pays for about one sample per pixel: for LEAST_SAMPLES."""
        return seconds >= self.time_s(LEAST_SAMPLES)

    def samples_for(self, seconds: float) -> int:
        """The samples per pixel that a time pays for, as a whole number of at least 1."""
        return int(np.clip(round((seconds - self.fixed_s) / self.sample_s), 1, MOST_SAMPLES))

    def per_sample_s(self, seconds: float) -> float:
        """The time of each of the samples per pixel that a time pays for."""
        samples = self.samples_for(seconds)
        return self.time_s(samples) / samples


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
        """The error of one image: relMSE, or relative loss (see `noise`)."""
        return max(float(np.mean(self.own)), 1e-30)

    @property
    def ratio(self) -> float:
        """The error of one image over that of plain path tracing."""
        return self.mean / max(float(np.mean(self.plain)), 1e-30)

    def relative_spread(self, other: RelativeErrors) -> float | None:
        """The relative standard error of one candidate's `ratio` over another's; None from a single value each.

        It is the standard error of a ratio of means (Cochran, *Sampling Techniques*, 6.5), taken over views. So it
        contains the noise and the choice of views; the error of measured times is negligible. If both candidates have
        the same number of images, the errors of plain path tracing cancel. Otherwise the two ratios are taken as
        independent, which overstates the result.
        """
        n = len(self.own)
        if n < 2 or len(other.own) < 2:
            return None
        own, plain, others, others_plain = (
            np.array(errors) / max(float(np.mean(errors)), 1e-30)
            for errors in (self.own, self.plain, other.own, other.plain)
        )
        parts = [own - others] if self.images == other.images else [own - plain, others - others_plain]
        return math.sqrt(sum(float(np.sum(part**2)) / (len(part) * (len(part) - 1)) for part in parts))


class MeasuredCandidate(Frozen):
    """One candidate, as a pilot measured it."""

    candidate: Candidate
    errors: RelativeErrors  # of images of the pilot's samples per pixel
    missed: float  # the part of the error inferred from light that other candidates found (see `noise`)
    cost: ImageCost  # of an image as it is used later


# --------------------------------------------------------------------------------------------------------- comparison


@dataclass(frozen=True, slots=True)
class CandidateAtCost:
    """A measured candidate with the samples per pixel that fit a time."""

    candidate: Candidate
    errors: RelativeErrors
    missed: float
    samples: int
    error: float  # of an image of so many samples: relMSE, or relative loss (see `noise`)
    time_s: float  # of such an image
    fits: bool  # whether at least about one sample per pixel fits the time
    relative_cost: float  # error × time over that of plain path tracing: the time to the same error
    spread: float | None  # standard error of relative_cost; None from a single pair of images


AtEqualCost: TypeAlias = dict[Candidate, CandidateAtCost]


def compare_at_cost(measured: Iterable[MeasuredCandidate], spp: int, seconds: float) -> AtEqualCost:
    """The candidates, measured with `spp` samples per pixel, at those samples that fit a time for each of them.

    The variance of an image is that of one sample over the number of samples n. So error × time is the error of one
    sample × time / n.
    """
    by_candidate = {one.candidate: one for one in measured}
    plain, found = by_candidate[PLAIN], {}
    for one in by_candidate.values():
        samples = one.cost.samples_for(seconds)
        relative_cost = one.errors.ratio * one.cost.per_sample_s(seconds) / plain.cost.per_sample_s(seconds)
        relative = one.errors.relative_spread(plain.errors)
        found[one.candidate] = CandidateAtCost(
            candidate=one.candidate,
            errors=one.errors,
            missed=one.missed,
            samples=samples,
            error=one.errors.mean * spp / samples,
            time_s=one.cost.time_s(samples),
            fits=one.cost.pays(seconds),
            relative_cost=relative_cost,
            spread=None if relative is None else relative_cost * relative,
        )
    return found


def best(candidates: Iterable[CandidateAtCost]) -> CandidateAtCost:
    """The candidate with the least error × time; those with few images are not asked, who may be the best by chance."""
    compared = list(candidates)
    most = max(one.errors.images for one in compared)
    return min((one for one in compared if one.errors.images == most), key=lambda one: one.relative_cost)


@dataclass(frozen=True, slots=True)
class Saving:
    """How much sooner one candidate reaches the error of another."""

    factor: float  # the other's time over this one's, to equal error
    spread: float | None  # its standard error

    @property
    def deviations(self) -> float:
        """log(factor) in standard errors, so that a factor and its inverse differ only in sign; 0 if unknown."""
        return 0.0 if self.spread is None else math.log(self.factor) / max(self.spread / self.factor, 1e-9)

    @property
    def significant(self) -> bool:
        """Whether the saving is worth a change of settings."""
        return self.factor >= 1 + WORTHWHILE and self.deviations >= CLEAR


def saving(one: CandidateAtCost, over: CandidateAtCost) -> Saving:
    """The saving of one candidate over another, from the errors and times of both."""
    factor = over.relative_cost / one.relative_cost
    relative = over.errors.relative_spread(one.errors)
    return Saving(factor, None if relative is None else factor * relative)
