"""Lines that say what is being done, so that nothing is silent for long."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Self

from photonfarm.renderer.importing.imported import Say

EVERY_S = 4.0
"""The longest silence: then the last line is said again, with its time."""


class Progress:
    """Says what it is given, and while nothing new comes, for how long that has gone on."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._what, self._since, self._said = "", 0.0, 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._repeat, daemon=True)

    def __call__(self, what: str) -> None:
        """Say what begins now."""
        self._what, self._since, self._said = what, time.monotonic(), time.monotonic()
        self._say(what)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._ended.wait(EVERY_S / 8):
            now = time.monotonic()
            if self._what and now - self._said > EVERY_S:
                self._said = now
                self._say(f"… {self._what} ({now - self._since:.0f} s)")
