"""Lines that say what long work does and how far it is, at least every few seconds; spans of time in words."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from photonfarm.core.processes import repeat

SILENCE_S = 5.0
"""The longest time without a line."""

Log = Callable[[str], object]
"""A function that takes a line."""


class WorkLog:
    """A context manager: `begin` says what is done from now on, and a thread says it again, with the time it takes."""

    def __init__(self, log: Log, silence_s: float = SILENCE_S) -> None:
        """Take where the lines go, and the longest silence between them."""
        self._log, self._silence_s = log, silence_s
        self._what, self._begun = "", time.monotonic()
        self._said = self._begun
        self._how_far: Callable[[], str] | None = None
        self._watching = repeat(silence_s / 10, self._repeat)

    def __enter__(self) -> Self:
        """Begin to watch for silence."""
        self._watching.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Say no more."""
        self._watching.__exit__(None, None, None)

    def begin(self, what: str, how_far: Callable[[], str] | None = None) -> None:
        """Say what is done now; `how_far` says how far that is, whenever it is said again."""
        self._what, self._how_far, self._begun = what, how_far, time.monotonic()
        self._log(what)

    def _repeat(self) -> None:
        now = time.monotonic()
        if now - max(self._said, self._begun) >= self._silence_s * 0.85 and self._what:
            self._said = now
            far = f", {self._how_far()}" if self._how_far else ""
            self._log(f"{self._what}: {now - self._begun:.0f} s so far{far}")


@contextmanager
def tell_waiting(log: Log, what: str, silence_s: float = SILENCE_S) -> Iterator[None]:
    """Say what is done, and every few seconds for how long it has been, until the block ends."""
    with WorkLog(log, silence_s) as work:
        work.begin(what)
        yield


class Steps:
    """How far some steps of about equal length are, and how long the rest should take.

    While a step is in hand, what it should take becomes less, and never more.
    """

    def __init__(self, total: int, *, slow: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        """Take how many there are; the first `slow` take longer than the others, as they compile."""
        self.total, self._slow, self._clock = total, slow, clock
        self._done, self._in_hand, self._pace_s = 0, 1, 0.0
        self._counted = self._last = clock()

    def reach(self, done: int) -> None:
        """Note how many are done."""
        if done <= self._done:
            return
        now = self._clock()
        begun, before = (self._counted, self._slow) if done > self._slow else (self._last, self._done)
        self._pace_s = (now - begun) / (done - before)
        self._in_hand, self._done, self._last = done - self._done, done, now
        if done <= self._slow:
            self._counted = now

    @property
    def left_s(self) -> float | None:
        """The seconds that the rest should take, or, after slow steps alone, takes at most; None before the first."""
        if not self._done:
            return None
        rest, since_s = self.total - self._done, self._clock() - self._last
        return max(self._pace_s * rest - since_s, self._pace_s * (rest - self._in_hand), 0.0)

    def words(self) -> str:
        """Both in words."""
        far = f"{self._done} of {self.total}"
        if (left_s := self.left_s) is None:
            return far
        return f"{far}, {'about' if self._done > self._slow else 'at most'} {format_span(left_s)} left"


def format_span(seconds: float) -> str:
    """A span of time as people say it: 45 s, 12 min, 3.4 h, 2.1 days."""
    if seconds < 100:
        return f"{max(seconds, 0):.0f} s"
    if seconds < 5940:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} days"


# ---------------------------------------------------------------------------------------------------------------- looks

LOOK_SHARE = 0.05
"""The most of the time that somebody who waits for news spends on looking for them."""

LOOK_PAUSE_MOST_S = 60.0
"""The longest pause that a slow look asks for: a single one may have been slow by accident."""


def pause_after_look(took_s: float, usual_s: float) -> float:
    """The seconds until the next look at something, whose last look took some: the usual ones, or more if it is slow.

    Looks at a store take longer the more it holds, and so come less often.
    """
    return max(usual_s, min(took_s / LOOK_SHARE, LOOK_PAUSE_MOST_S))
