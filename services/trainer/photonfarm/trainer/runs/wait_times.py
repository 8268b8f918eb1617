"""Where a run's time goes: whether rendering, reading or training is what the others wait for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

Kind = Literal["start", "train", "validate", "wait_data", "wait_read", "save", "other"]
"""What time goes to: building network and feed; steps; validations; waiting for samples to be rendered, and to be read;
checkpoints; and what is left, as writing the log and drawing."""

KINDS: tuple[Kind, ...] = ("start", "train", "validate", "wait_data", "wait_read", "save", "other")

Bottleneck = Literal["rendering", "reading", "training"]

NONE: Mapping[str, float] = {}


class Stopwatch:
    """The seconds of a run by what they go to: at any moment to one kind, so that together they are its wall time."""

    def __init__(self, clock: Callable[[], float], kind: Kind, ahead: float = 0.0) -> None:
        """Begin with `kind`, to which `ahead` seconds have gone already."""
        self._clock, self._kind, self._since = clock, kind, clock() - ahead
        self._spent: dict[str, float] = dict.fromkeys(KINDS, 0.0)

    @property
    def seconds(self) -> dict[str, float]:
        """Up to now, by kind."""
        self.turn(self._kind)
        return dict(self._spent)

    @property
    def total(self) -> float:
        """All of them together."""
        return sum(self.seconds.values())

    def add(self, seconds: Mapping[str, float]) -> None:
        """Count those of an earlier session of the run."""
        for kind, value in seconds.items():
            self._spent[kind] += value

    def turn(self, kind: Kind) -> Kind:
        """Let time go to another kind from now on; returns which it went to."""
        before, now = self._kind, self._clock()
        self._spent[before] += now - self._since
        self._kind, self._since = kind, now
        return before

    @contextmanager
    def on(self, kind: Kind) -> Iterator[None]:
        """Let time go to a kind for a while."""
        before = self.turn(kind)
        try:
            yield
        finally:
            self.turn(before)


def waits(seconds: Mapping[str, float], before: Mapping[str, float] = NONE) -> dict[str, float]:
    """The shares of the time since `before` in which training waited, for samples to be rendered, and to be read."""
    spent = {name: value - before.get(name, 0.0) for name, value in seconds.items()}
    total = max(sum(spent.values()), 1e-9)
    return {"samples": round(spent["wait_data"] / total, 4), "reading": round(spent["wait_read"] / total, 4)}


def bottleneck(shares: Mapping[str, float]) -> Bottleneck:
    """What to speed up: that to which most of the time goes, by `waits`, the rest of it being training."""
    spent: dict[Bottleneck, float] = {"rendering": shares["samples"], "reading": shares["reading"]}
    spent["training"] = 1 - sum(spent.values())
    return max(spent, key=lambda name: spent[name])


def samples_per_used(samples: int, draws: int) -> float:
    """Samples that have arrived for each that has been used: above their `--ahead`, workers leave the scene alone.

    Used are as many as have been drawn, and held-out ones at once: what Redis is told for the workers.
    """
    return samples / max(min(draws, samples), 1)


def stated(shares: Mapping[str, float], ahead: float) -> str:
    """Both waits, the workers' side and what it comes to, as part of a line."""
    return (
        f"waited {shares['samples']:.1%} of the time for samples and {shares['reading']:.1%} for reading, "
        f"{ahead:.2f} samples there for each used (--ahead): {bottleneck(shares)} is the bottleneck"
    )
