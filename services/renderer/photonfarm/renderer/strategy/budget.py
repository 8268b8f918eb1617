"""The processor time of images, and what fits into the time that a measurement may take in all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field
from math import ceil
from typing import TypeVar

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidates import Candidate, Render
from photonfarm.renderer.strategy.pilot import LEAST_PAIRS, SCOUTS

T = TypeVar("T")

LEAST_SAMPLES = 0.7
"""The least samples per pixel that a time must pay for: rounded to 1 they cost 1.4 times as much at most."""

MOST_SAMPLES = 65536
"""The largest number of samples per pixel in a spec."""

LEAST_TURNS, MOST_TURNS = 3, 60

RANGE = 4
"""The larger over the smaller of the two numbers of samples that are timed."""

LEAST_VIEWS = 3
"""The views of a pilot at least."""

TRACES = 5
"""How often a candidate is traced again: for other numbers of samples, and on the pilot's film."""

MARGIN = 1.3
"""What the time is multiplied by that more settings are expected to take: pilots took up to 1.2 times as long."""

EDITS = 5
"""How often a pilot brings the scene into each view's configuration, about."""


@dataclass(slots=True)
class Budget:
    """Processor seconds for all of a measurement: loading, compiling and timing count."""

    seconds: float
    clock: Callable[[], float] = backend.work_s
    begun: float = field(init=False)

    def __post_init__(self) -> None:
        self.begun = self.clock()

    @property
    def spent_s(self) -> float:
        """What has been used of it."""
        return self.clock() - self.begun

    @property
    def left_s(self) -> float:
        """What is left of it; negative once it is overdrawn."""
        return self.seconds - self.spent_s

    def words(self) -> str:
        """How far it is used, in words."""
        return f"{self.spent_s:.0f} of {self.seconds:g} s of processor time"

    def require(self, what: str, more_s: float, best_s: float) -> None:
        """Raise IncompleteError unless `more_s` are left, needed for `what`; `best_s` would do all that is of use."""
        if more_s > self.left_s:
            least, best = (10 * ceil((self.spent_s + seconds) / 10) for seconds in (more_s, max(best_s, more_s)))
            raise IncompleteError(
                f"{what} does not fit in --seconds {self.seconds:g}: {self.spent_s:.0f} s of processor time are used, "
                f"and about {max(ceil(more_s), 1)} s more are needed; give it {least}"
                + (f", or {best} for all settings" if best > least else "")
            )

    def take_within(self, share: float, items: Iterable[T], least: int) -> Iterator[T]:
        """The items for as long as no more than a share of the whole time is used; so many in any case."""
        for count, item in enumerate(items):
            yield item
            if count + 1 >= least and self.spent_s > share * self.seconds:
                return


def affordable(
    render: Render, candidates: Iterable[Candidate], first: Set[Candidate], budget: Budget, edit_s: float, what: str
) -> list[Candidate]:
    """The candidates that there is time to compare, compiled by rendering each; those in `first` are among them.

    `edit_s` is the time to bring the scene into another configuration. Raises IncompleteError if there is no time for
    those in `first`; `what` is what does not fit then.
    """
    ordered = sorted(candidates, key=lambda candidate: candidate not in first)
    compiling: list[float] = []
    images: list[float] = []

    def needed_s(count: int) -> float:
        timed = (LEAST_TURNS + 1) * (1 + RANGE) * count
        of_a_view = max(SCOUTS, count) + 2 * -(-LEAST_PAIRS // LEAST_VIEWS) * count
        rendered_s = (timed + LEAST_VIEWS * of_a_view) * np.mean(images)
        return float(rendered_s + TRACES * count * min(compiling) + EDITS * LEAST_VIEWS * edit_s)

    for count, candidate in enumerate(ordered, 1):
        if count > len(first) and MARGIN * needed_s(count) + min(compiling) > budget.left_s:
            return ordered[: count - 1]
        for seconds in (compiling, images):
            begun = budget.clock()
            render(candidate, 0, 1)
            seconds.append(budget.clock() - begun)
        if count <= len(first):
            every = MARGIN * needed_s(len(ordered)) + (len(ordered) - count) * min(compiling)
            budget.require(what, needed_s(len(first)) + (len(first) - count) * min(compiling), every)
    return ordered


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

    def halve(self) -> ImageCost:
        """The cost of one of two half-estimates that share a launch, and so the fixed part of an image."""
        return ImageCost(self.fixed_s / 2, self.sample_s)

    def times(self, factor: float) -> ImageCost:
        """The cost on a machine that is slower by a factor."""
        return ImageCost(factor * self.fixed_s, factor * self.sample_s)

    def time_s(self, spp: float) -> float:
        """The time of an image with `spp` samples per pixel."""
        return self.fixed_s + spp * self.sample_s

    def pays(self, seconds: float) -> bool:
        """Whether a time pays for about one sample per pixel: for LEAST_SAMPLES."""
        return seconds >= self.time_s(LEAST_SAMPLES)

    def bought(self, seconds: float) -> int:
        """The samples per pixel that a time pays for, as a whole number of at least 1."""
        return int(np.clip(round((seconds - self.fixed_s) / self.sample_s), 1, MOST_SAMPLES))

    def per_sample_s(self, seconds: float) -> float:
        """The time of each of the samples per pixel that a time pays for."""
        samples = self.bought(seconds)
        return self.time_s(samples) / samples


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
