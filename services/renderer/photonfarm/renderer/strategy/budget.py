"""The time that a measurement may take in all, and what fits into it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import dataclass, field
from math import ceil
from typing import TypeVar

import numpy as np

from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidate import Candidate, Render
from photonfarm.renderer.strategy.image_cost import LEAST_TURNS, RANGE
from photonfarm.renderer.strategy.pilot import LEAST_PAIRS
from photonfarm.renderer.strategy.rounds import SCOUTS
from photonfarm.shared.core.errors import IncompleteError

T = TypeVar("T")

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
            least, best = (_tens(self.spent_s + seconds) for seconds in (more_s, max(best_s, more_s)))
            raise IncompleteError(
                f"{what} does not fit in --seconds {self.seconds:g}: {self.spent_s:.0f} s of processor time are used, "
                f"and about {max(ceil(more_s), 1)} s more are needed; give it {least}"
                + (f", or {best} for all settings" if best > least else "")
            )

    def within(self, share: float, items: Iterable[T], least: int) -> Iterator[T]:
        """The items for as long as no more than a share of the whole time is used; so many in any case."""
        for count, item in enumerate(items):
            yield item
            if count + 1 >= least and self.spent_s > share * self.seconds:
                return


def _tens(seconds: float) -> int:
    return 10 * ceil(seconds / 10)


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

    def needed(count: int) -> float:
        timed = (LEAST_TURNS + 1) * (1 + RANGE) * count
        of_a_view = max(SCOUTS, count) + 2 * -(-LEAST_PAIRS // LEAST_VIEWS) * count
        rendered_s = (timed + LEAST_VIEWS * of_a_view) * np.mean(images)
        return float(rendered_s + TRACES * count * min(compiling) + EDITS * LEAST_VIEWS * edit_s)

    for count, candidate in enumerate(ordered, 1):
        if count > len(first) and MARGIN * needed(count) + min(compiling) > budget.left_s:
            return ordered[: count - 1]
        for seconds in (compiling, images):
            begun = budget.clock()
            render(candidate, 0, 1)
            seconds.append(budget.clock() - begun)
        if count <= len(first):
            every = MARGIN * needed(len(ordered)) + (len(ordered) - count) * min(compiling)
            budget.require(what, needed(len(first)) + (len(first) - count) * min(compiling), every)
    return ordered
