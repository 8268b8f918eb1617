"""The losses of the last steps, and whether they are those of a run that diverges.

They are read from the device every `LOOK_EVERY` steps, so that no step waits for a card.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

LOOK_EVERY = 10  # steps; equal on every device, so that runs are

BEFORE = 100  # steps, before those

FEW = 30
"""The losses below which those before say nothing of what is usual; and the first steps whose untrained losses do."""

SHARE = 0.1
"""The share of the losses before that exceed the usual ones."""

UNUSUAL = 9
"""How many of the last `LOOK_EVERY` losses are above the usual ones in a run that diverges."""

FACTOR, HIGH = 5.0, 3
"""And `HIGH` of them are above `FACTOR` times those, so that no run goes back for losses that creep up."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the last losses say of a run."""

    now: float  # the loss that `HIGH` of the last ones reach
    usual: float  # the loss that only `SHARE` of those before exceed, or of the untrained ones if these are lower
    is_diverging: bool
    is_calm: bool  # the median of the last ones is a usual loss

    @property
    def sentence(self) -> str:
        """Both losses in words."""
        if not math.isfinite(self.now):
            return "the loss is not finite"
        return f"the loss is {self.now:.5g} or more in {HIGH} of {LOOK_EVERY} steps, and was up to {self.usual:.5g}"


def judge(losses: Sequence[float], untrained: Sequence[float]) -> Judgement:
    """Judge the last `LOOK_EVERY` losses by those before, and in the first `BEFORE` steps by the `untrained` ones too.

    These are the losses of the network as it was before any step, on the batches of the first steps. So a run that
    diverges from its beginning does not pass its own faults off as usual.

    It is no fault of a run that a batch holds rare bright samples, and to go back on their account would darken what it
    learns, as clipping does. So what counts is how many losses are unusual, and not by how much. Whatever the tail of
    the distribution that losses are drawn from, 9 of 10 exceed nine tenths of the 100 before once in 50 million steps.
    """
    if not all(map(math.isfinite, losses)):
        return Judgement(math.nan, math.nan, is_diverging=True, is_calm=False)
    last, before = sorted(losses[-LOOK_EVERY:]), losses[:-LOOK_EVERY]
    now = last[-min(HIGH, len(last))]
    first = list(filter(math.isfinite, untrained))  # those of a damaged batch are not
    by_untrained = _find_usual(first) if first and len(before) < BEFORE else math.inf
    usual = min(_find_usual(before) if len(before) >= FEW else math.inf, by_untrained)
    if len(last) < LOOK_EVERY or usual == math.inf:
        return Judgement(now, usual, is_diverging=False, is_calm=True)
    is_high = now > usual + (FACTOR - 1) * abs(usual)
    is_calm = last[LOOK_EVERY // 2] <= usual
    return Judgement(now, usual, is_diverging=is_high and last[-UNUSUAL] > usual, is_calm=is_calm)


def _find_usual(losses: Sequence[float]) -> float:
    """The loss that only `SHARE` of these exceed."""
    return sorted(losses)[math.ceil((1 - SHARE) * len(losses)) - 1]


class RecentLosses:
    """The losses of the last steps, the latest of them still on the device."""

    def __init__(self) -> None:
        self._read: deque[float] = deque(maxlen=BEFORE + LOOK_EVERY)
        self._unread: list[Tensor] = []

    def add(self, loss: Tensor) -> None:
        """Add the loss of a step, (), without waiting for it."""
        self._unread.append(loss)

    def read(self) -> list[float]:
        """Read those on the device, and return all."""
        if self._unread:
            self._read.extend(torch.stack(self._unread).tolist())
            self._unread.clear()
        return list(self._read)

    def state(self) -> Tensor:
        """All losses, for a checkpoint: (n,) float64."""
        return torch.tensor(self.read(), dtype=torch.float64)

    def restore(self, state: Tensor) -> None:
        """Continue from a `state`."""
        self._unread.clear()
        self._read.clear()
        self._read.extend(state.tolist())
