"""Looks at the farm that are shared by all who ask, browsers and scrapers.

Each is kept for a hundred times as long as it took: so whoever looks, and however large the store is, looking takes
about a hundredth of a core.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

LEAST_S = 2.0
"""The least seconds between two looks."""

SHARE = 0.01
"""The most of a core that looks take, on average."""

T = TypeVar("T")


class Kept(Generic[T]):
    """A value that is made anew now and then, so that making it takes at most SHARE of the time."""

    def __init__(
        self,
        make: Callable[[], T],
        *,
        clock: Callable[[], float] = time.monotonic,
        work: Callable[[], float] = time.thread_time,
    ) -> None:
        """Take the function that makes it; `work` counts the seconds of a core that this takes."""
        self._make, self._clock, self._work = make, clock, work
        self._lock = threading.Lock()
        self._due = 0.0
        self._value: T | None = None

    def get(self) -> T:
        """The value, made anew if that is due; raises what making it raises."""
        with self._lock:
            if self._value is None or self._clock() >= self._due:
                began = self._work()
                self._value = self._make()
                self._due = self._clock() + max(LEAST_S, (self._work() - began) / SHARE)
            return self._value
