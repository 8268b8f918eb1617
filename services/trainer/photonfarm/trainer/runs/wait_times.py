"""Measures what a run spends its time on, and which of rendering, reading and training is the bottleneck."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

TimeKind = Literal["start", "train", "validate", "wait_data", "wait_read", "save", "other"]
"""The kinds of time.

In this order: building the network and the feed; steps; validations; waiting for samples to be rendered; waiting for
samples to be read; writing checkpoints; and the rest, such as writing the log and drawing.
"""

KINDS: tuple[TimeKind, ...] = ("start", "train", "validate", "wait_data", "wait_read", "save", "other")

Bottleneck = Literal["rendering", "reading", "training"]

NONE: Mapping[str, float] = {}


class Stopwatch:
    """Counts the seconds of a run by kind. At any moment exactly one kind is counted, so their sum is the wall time."""

    def __init__(
        self,
        clock: Callable[[], float],
        kind: TimeKind,
        ahead: float = 0.0,
        on_turn: Callable[[TimeKind], object] | None = None,
    ) -> None:
        """Begin to count `kind`, which has `ahead` seconds already; `on_turn` is told each kind that begins."""
        self._on_turn = on_turn
        self._clock, self._kind, self._since = clock, kind, clock() - ahead
        self._spent: dict[str, float] = dict.fromkeys(KINDS, 0.0)

    @property
    def seconds(self) -> dict[str, float]:
        """The seconds so far, by kind."""
        self.turn(self._kind)
        return dict(self._spent)

    @property
    def total(self) -> float:
        """The sum of all kinds."""
        return sum(self.seconds.values())

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add the seconds of an earlier session of the run."""
        for kind, value in seconds.items():
            self._spent[kind] += value

    def turn(self, kind: TimeKind) -> TimeKind:
        """Switch to another kind; returns the one before."""
        before, now = self._kind, self._clock()
        self._spent[before] += now - self._since
        self._kind, self._since = kind, now
        if self._on_turn is not None:
            self._on_turn(kind)
        return before

    @contextmanager
    def on(self, kind: TimeKind) -> Iterator[None]:
        """Switch to a kind while the block runs."""
        before = self.turn(kind)
        try:
            yield
        finally:
            self.turn(before)


def wait_shares(seconds: Mapping[str, float], before: Mapping[str, float] = NONE) -> dict[str, float]:
    """The shares of the time since `before` in which training waited for samples to be rendered, and to be read."""
    spent = {name: value - before.get(name, 0.0) for name, value in seconds.items()}
    total = max(sum(spent.values()), 1e-9)
    return {"samples": round(spent["wait_data"] / total, 4), "reading": round(spent["wait_read"] / total, 4)}


def bottleneck(shares: Mapping[str, float]) -> Bottleneck:
    """The part that takes most of the time, by `wait_shares`; the rest of the time counts as training."""
    spent: dict[Bottleneck, float] = {"rendering": shares["samples"], "reading": shares["reading"]}
    spent["training"] = 1 - sum(spent.values())
    return max(spent, key=lambda name: spent[name])


def samples_per_used(samples: int, draws: int) -> float:
    """The number of arrived samples for each used one; workers skip the scene while it is above their `--ahead`.

    A sample counts as used once it is drawn, and a held-out one as soon as it arrives, as in the number that workers
    read from Redis.
    """
    return samples / max(min(draws, samples), 1)


def stated(shares: Mapping[str, float], ahead: float) -> str:
    """The shares of `wait_shares`, the arrived samples for each used one, and the bottleneck, as part of a line."""
    return (
        f"waited {shares['samples']:.1%} of the time for samples and {shares['reading']:.1%} for reading, "
        f"{ahead:.2f} samples there for each used (--ahead): {bottleneck(shares)} is the bottleneck"
    )
