"""What a trainer is doing now, for people: a small file in the run's folder, and a line now and then."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from photonfarm.core.files import write_whole
from photonfarm.core.processes import repeat
from photonfarm.core.waiting import format_span
from photonfarm.farm.training import PROGRESS, TRAINS, WAITS, count_steps
from photonfarm.trainer.runs.wait_times import TimeKind

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
    """Follows a session of training; `phase` and `drawn` are its hooks."""

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

    def drawn(self, draws: int, samples: int) -> None:
        """Note the samples drawn so far, and those that have arrived."""
        self._step, self._samples = draws // self._batch, samples

    def look(self) -> dict[str, object]:
        """The present state, as the file holds it."""
        now, (kind, since) = self._clock(), self._phase
        self._history.append((now, self._step))
        (began, first), left = self._history[0], None
        if self._step > first:
            left = max(self._steps - self._step, 0) * (now - began) / (self._step - first)
        phase = WORDS[kind] if now - since >= SHORT_S or not self._step else TRAINS
        return {
            "step": self._step, "steps": self._steps, "samples": self._samples, "phase": phase,
            "phase_s": round(now - since, 1), "left_s": left, "at_s": time.time(),
        }  # fmt: skip

    def line(self) -> str:
        """The present state in words."""
        found = self.look()
        left = f", {format_span(found['left_s'])} left" if isinstance(found["left_s"], float) else ""
        since = f" for {found['phase_s']:.0f} s" if found["phase"] != TRAINS else ""
        return f"{self._steps_done}: {found['phase']}{since}, {self._samples} samples have arrived{left}"

    def last_line(self) -> str:
        """The state at the end of the session, in words; "" if nothing has arrived."""
        return f"{self._steps_done}, {self._samples} samples have arrived" if self._samples else ""

    @property
    def _steps_done(self) -> str:
        return f"step {count_steps(self._step, self._steps)}"


@contextmanager
def followed(progress: RunProgress, run: Path, say: Callable[[str], object] | None) -> Iterator[None]:
    """Keep the file up to date until the block ends; say a line every five seconds, and a last one."""
    said = time.monotonic()

    def follow() -> None:
        nonlocal said
        with suppress(OSError):
            write_whole(run / PROGRESS, json.dumps(progress.look()))
        if say is not None and time.monotonic() - said >= LINE_S - FILE_S / 2:
            said = time.monotonic()
            say(progress.line())

    try:
        with repeat(FILE_S, follow):
            yield
        if say is not None and (last := progress.last_line()):
            say(last)
    finally:
        with suppress(OSError):
            (run / PROGRESS).unlink(missing_ok=True)
