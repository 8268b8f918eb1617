"""What a trainer spends its time on, and how far it is: in a small file of the run's folder, and a line now and then.

From the times follows which of rendering, reading and training is the bottleneck.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, get_args

from photonfarm.core.files import write_whole
from photonfarm.core.formatting import format_count
from photonfarm.core.processes import repeat
from photonfarm.core.waiting import format_span
from photonfarm.farm.training import PROGRESS, TRAINS, WAITS, count_steps

TimeKind = Literal["start", "train", "validate", "wait_data", "wait_read", "save", "other"]
"""The kinds of time.

In this order: building the network and the feed; steps; validations; waiting for samples to be rendered; waiting for
samples to be read; writing checkpoints; and the rest, such as writing the log and drawing.
"""

KINDS: tuple[TimeKind, ...] = get_args(TimeKind)


class Stopwatch:
    """Counts the seconds of a run by kind. At any moment exactly one kind is counted, so their sum is the wall time."""

    def __init__(
        self, clock: Callable[[], float], kind: TimeKind, ahead: float, on_turn: Callable[[TimeKind], object] | None
    ) -> None:
        """Begin to count `kind`, which has `ahead` seconds already; `on_turn` is told each kind that begins."""
        self._clock, self._kind, self._since, self._on_turn = clock, kind, clock() - ahead, on_turn
        self._spent: dict[str, float] = dict.fromkeys(KINDS, 0.0)

    @property
    def seconds(self) -> dict[str, float]:
        """The seconds so far, by kind."""
        self.turn(self._kind)
        return dict(self._spent)

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


def share_waits(seconds: Mapping[str, float], before: Mapping[str, float]) -> dict[str, float]:
    """The shares of the time since `before` in which training waited for samples to be rendered, and to be read."""
    spent = {name: value - before.get(name, 0.0) for name, value in seconds.items()}
    total = max(sum(spent.values()), 1e-9)
    return {"samples": round(spent["wait_data"] / total, 4), "reading": round(spent["wait_read"] / total, 4)}


def find_bottleneck(shares: Mapping[str, float]) -> str:
    """The part that takes most of the time, by `share_waits`; the rest of the time counts as training."""
    spent = {"rendering": shares["samples"], "reading": shares["reading"]}
    spent["training"] = 1 - sum(spent.values())
    return max(spent, key=lambda name: spent[name])


def divide_by_used(samples: int, draws: int) -> float:
    """The number of arrived samples for each used one; workers skip the scene while it is above their `--ahead`.

    A sample counts as used once it is drawn, and a held-out one as soon as it arrives, as in the number that workers
    read from Redis.
    """
    return samples / max(min(draws, samples), 1)


def format_waits(shares: Mapping[str, float], ahead: float) -> str:
    """The shares of `share_waits`, the arrived samples for each used one, and the bottleneck, as part of a line."""
    return (
        f"waited {shares['samples']:.1%} of the time for samples and {shares['reading']:.1%} for reading, "
        f"{ahead:.2f} samples there for each used (--ahead): {find_bottleneck(shares)} is the bottleneck"
    )


FILE_S = 2.0  # between two versions of the file
LINE_S = 5.0  # between two lines
SHORT_S = 1.0  # a phase that is over sooner is a part of training
WINDOW = 30  # the versions over which the pace is taken: a minute

WORDS: dict[TimeKind, str] = {
    "start": "builds the network",
    "train": TRAINS,
    "validate": "validates",
    "wait_data": WAITS,
    "wait_read": "reads samples",
    "save": "writes a checkpoint",
    "other": TRAINS,
}


class RunProgress:
    """Follows a session of training; `phase` and `note_draws` are its hooks."""

    def __init__(self, steps: int, batch: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Take the last step, and the samples of each step."""
        self._steps, self._batch, self._clock = steps, batch, clock
        self._step = self._samples = 0
        self._phase: tuple[TimeKind, float] = ("wait_data", clock())
        self._history: deque[tuple[float, int]] = deque(maxlen=WINDOW)

    def phase(self, kind: TimeKind) -> None:
        """Note what the time is spent on from now on."""
        if kind != self._phase[0]:
            self._phase = (kind, self._clock())

    def note_draws(self, draws: int, samples: int) -> None:
        """Note the samples drawn so far, and those that have arrived."""
        self._step, self._samples = draws // self._batch, samples

    def look(self) -> dict[str, Any]:
        """The present state, as the file holds it."""
        now, (kind, since) = self._clock(), self._phase
        self._history.append((now, self._step))
        (began, first), left = self._history[0], None
        if self._step > first:
            left = max(self._steps - self._step, 0) * (now - began) / (self._step - first)
        return {
            "step": self._step,
            "steps": self._steps,
            "samples": self._samples,
            "phase": WORDS[kind] if now - since >= SHORT_S or not self._step else TRAINS,
            "phase_s": round(now - since, 1),
            "left_s": left,
            "at_s": time.time(),
        }

    def line(self) -> str:
        """The present state in words."""
        state = self.look()
        left = "" if state["left_s"] is None else f", {format_span(state['left_s'])} left"
        since = f" for {state['phase_s']:.0f} s" if state["phase"] != TRAINS else ""
        step = count_steps(self._step, self._steps)
        return f"step {step}: {state['phase']}{since}, {format_count(self._samples, 'sample')} arrived{left}"

    def last_line(self) -> str:
        """The state at the end of the session, in words; "" if nothing has arrived."""
        step = count_steps(self._step, self._steps)
        return f"step {step}, {format_count(self._samples, 'sample')} arrived" if self._samples else ""


@contextmanager
def follow_progress(progress: RunProgress, run: Path, say: Callable[[str], object]) -> Iterator[None]:
    """Keep the file up to date until the block ends; say a line every five seconds, and a last one."""
    said = time.monotonic()

    def follow() -> None:
        nonlocal said
        with suppress(OSError):
            write_whole(run / PROGRESS, json.dumps(progress.look()))
        if time.monotonic() - said >= LINE_S - FILE_S / 2:
            said = time.monotonic()
            say(progress.line())

    try:
        with repeat(FILE_S, follow):
            yield
        if last := progress.last_line():
            say(last)
    finally:
        with suppress(OSError):
            (run / PROGRESS).unlink(missing_ok=True)
