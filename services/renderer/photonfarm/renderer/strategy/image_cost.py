"""CPU time of images by their samples per pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from photonfarm.renderer.strategy.candidate import Candidate, Render

LEAST_SAMPLES, MOST_SAMPLES = 0.7, 65536
"""Samples per pixel that a time must pay for: rounded up to 1, they cost 1.4 times as much at most. A spec's most."""

LEAST_TURNS, MOST_TURNS = 3, 60

RANGE = 4
"""Largest over smallest number of samples that are timed: the smallest are those of a half-estimate, where they fit."""


@dataclass(frozen=True, slots=True)
class ImageCost:
    """CPU time of an image: what it takes whatever its samples are, and what each sample per pixel adds."""

    fixed_s: float
    sample_s: float

    @classmethod
    def through(cls, few: int, few_s: float, many: int, many_s: float) -> ImageCost:
        """From the times at two numbers of samples per pixel."""
        sample_s = max((many_s - few_s) / (many - few), 0.02 * few_s / few)  # where the fixed part's noise drowns it
        return cls(max(few_s - few * sample_s, 0.0), sample_s)

    def time_s(self, spp: float) -> float:
        """Of an image with so many samples per pixel."""
        return self.fixed_s + spp * self.sample_s

    def pays(self, seconds: float) -> bool:
        """Whether a time pays for a sample per pixel."""
        return seconds >= self.time_s(LEAST_SAMPLES)

    def bought(self, seconds: float) -> int:
        """Samples per pixel that a time buys, a whole number as in a spec, 1 at least."""
        return int(np.clip(round((seconds - self.fixed_s) / self.sample_s), 1, MOST_SAMPLES))


def time_images(
    render: Render, candidates: Sequence[Candidate], half_spp: int, seconds: float, clock: Callable[[], float]
) -> dict[Candidate, ImageCost]:
    """The cost of each candidate's images, in about `seconds` of `clock` and what compiling takes.

    Images of `half_spp` and of 4 times as many samples are timed, or fewer where these would take too long. The
    candidates take turns, so that what slows the machine down slows down all of them; medians count, of up to 60 turns
    and at least 3. The first turn, in which kernels are compiled and memory is allocated, does not count.
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
    """The two numbers of samples per pixel; an image of each takes about `seconds` together at most."""
    render(candidate, 0, 1)  # compiles
    one = _time_of(render, candidate, 1, clock)  # with the fixed part, which more samples do not take again
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
