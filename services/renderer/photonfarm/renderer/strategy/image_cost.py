"""Measures the CPU time of an image as a function of its samples per pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from photonfarm.renderer.strategy.candidate import Candidate, Render

LEAST_SAMPLES = 0.7
"""The least samples per pixel that a time must pay for: rounded to 1 they cost 1.4 times as much at most."""

MOST_SAMPLES = 65536
"""The largest number of samples per pixel in a spec."""

LEAST_TURNS, MOST_TURNS = 3, 60

RANGE = 4
"""The larger over the smaller of the two numbers of samples that are timed."""


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

    def of_a_half(self) -> ImageCost:
        """The cost of one of two half-estimates that share a launch, and so the fixed part of an image."""
        return ImageCost(self.fixed_s / 2, self.sample_s)

    def time_s(self, spp: float) -> float:
        """The time of an image with `spp` samples per pixel."""
        return self.fixed_s + spp * self.sample_s

    def pays(self, seconds: float) -> bool:
        """Whether a time pays for about one sample per pixel: for LEAST_SAMPLES."""
        return seconds >= self.time_s(LEAST_SAMPLES)

    def bought(self, seconds: float) -> int:
        """The samples per pixel that a time pays for, as a whole number of at least 1."""
        return int(np.clip(round((seconds - self.fixed_s) / self.sample_s), 1, MOST_SAMPLES))


def time_images(
    render: Render, candidates: Sequence[Candidate], half_spp: int, seconds: float, clock: Callable[[], float]
) -> dict[Candidate, ImageCost]:
    """The cost of each candidate's images, in about `seconds` of `clock` and the time to compile.

    Images of `half_spp` and of 4 times as many samples are timed, or fewer if these would take too long. The candidates
    take turns, so that a slower machine slows all of them down; medians are taken over at most 60 and at least 3 turns.
    The first turn, in which kernels are compiled and memory is allocated, does not count.
    """
    each_s = seconds / (LEAST_TURNS + 1) / len(candidates)
    samples = {candidate: _samples(render, candidate, half_spp, each_s, clock) for candidate in candidates}
    turns = [_turn(render, samples, clock)]
    begun = clock()
    while len(turns) <= LEAST_TURNS or (clock() - begun < seconds and len(turns) <= MOST_TURNS):
        turns.append(_turn(render, samples, clock))
    medians = np.median(turns[1:], axis=0)
    return {
        candidate: ImageCost.through(few, float(few_s), many, float(many_s))
        for (candidate, (few, many)), (few_s, many_s) in zip(samples.items(), medians, strict=True)
    }


def _samples(
    render: Render, candidate: Candidate, half_spp: int, seconds: float, clock: Callable[[], float]
) -> tuple[int, int]:
    """The two numbers of samples per pixel to time; two such images take about `seconds` together at most."""
    render(candidate, 0, 1)  # compiles
    one = _time_of(render, candidate, 1, clock)  # includes the fixed part, which more samples do not repeat
    few = int(np.clip(seconds / ((1 + RANGE) * max(one, 1e-9)), 1, half_spp))
    return few, RANGE * few


def _turn(
    render: Render, samples: dict[Candidate, tuple[int, int]], clock: Callable[[], float]
) -> list[tuple[float, float]]:
    return [
        (_time_of(render, candidate, few, clock), _time_of(render, candidate, many, clock))
        for candidate, (few, many) in samples.items()
    ]


def _time_of(render: Render, candidate: Candidate, spp: int, clock: Callable[[], float]) -> float:
    start = clock()
    render(candidate, 1, spp)
    return clock() - start
