"""The processor time that a measurement may take in all, what fits into it, and the times of images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import dataclass, field
from math import ceil

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidates import Candidate, ImageCost, Render

LEAST_TURNS, MOST_TURNS = 3, 60

RANGE = 4
"""The larger over the smaller of the two numbers of samples that are timed."""

COMPILING, REQUIRED = 0.5, 0.6
"""The largest shares of the time for compiling settings, and for compiling those that are always compared."""


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

    def require(self, what: str, share: float = 1.0) -> None:
        """Raise IncompleteError if more than a share of the time is used, once `what` is done."""
        if self.spent_s > share * self.seconds:
            raise IncompleteError(
                f"{what} does not fit in --seconds {self.seconds:g}: {self.spent_s:.0f} s of processor time are used; "
                f"give it {10 * ceil(self.spent_s / share / 10)}"
            )


def compile_within(
    render: Render, candidates: Iterable[Candidate], required: Set[Candidate], budget: Budget, what: str
) -> list[Candidate]:
    """The candidates that there is time to compare, compiled by rendering each; the `required` ones are among them.

    Raises IncompleteError if there is no time for these; `what` is what does not fit then.
    """
    ordered = sorted(candidates, key=lambda candidate: candidate not in required)
    for candidate in ordered[: len(required)]:
        render(candidate, 0, 1)
    budget.require(what, REQUIRED)
    for count, candidate in enumerate(ordered[len(required) :], len(required)):
        if budget.spent_s > COMPILING * budget.seconds:
            return ordered[:count]
        render(candidate, 0, 1)
    budget.require(what)
    return ordered


def time_images(
    renders: Sequence[Render],
    candidates: Sequence[Candidate],
    half_spp: int,
    seconds: float,
    clock: Callable[[], float],
) -> dict[Candidate, ImageCost]:
    """The cost of each candidate's images of some views, in about `seconds` of `clock` and the time to compile.

    Images of `half_spp` and of 4 times as many samples are timed, or fewer if these would take too long. The candidates
    take turns, so that a slower machine slows all of them down, and turns go from view to view. Medians are taken over
    at most 60 and at least 3 turns. The first turn, in which kernels are compiled and memory is allocated, does not
    count.
    """
    each_s = seconds / (LEAST_TURNS + 1) / len(candidates)
    samples = {}
    for candidate in candidates:
        _time_of(renders[0], candidate, 1, clock)  # compiles
        one = _time_of(renders[0], candidate, 1, clock)  # includes the fixed part, which more samples do not repeat
        few = int(np.clip(each_s / ((1 + RANGE) * max(one, 1e-9)), 1, half_spp))
        samples[candidate] = few, RANGE * few

    turns: list[list[list[float]]] = []
    begun = clock()
    while len(turns) <= LEAST_TURNS or (clock() - begun < seconds and len(turns) <= MOST_TURNS):
        render = renders[len(turns) % len(renders)]
        turns.append([[_time_of(render, c, spp, clock) for spp in both] for c, both in samples.items()])
        if len(turns) == 1:
            begun = clock()
    medians = np.median(turns[1:], axis=0)
    return {
        candidate: ImageCost.through(few, float(few_s), many, float(many_s))
        for (candidate, (few, many)), (few_s, many_s) in zip(samples.items(), medians, strict=True)
    }


def _time_of(render: Render, candidate: Candidate, spp: int, clock: Callable[[], float]) -> float:
    start = clock()
    render(candidate, 1, spp)
    return clock() - start
