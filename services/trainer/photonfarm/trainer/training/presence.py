"""A trainer's presence in its scene: announced while it reads there, and ended for whoever takes the scene's lease."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from photonfarm.shared.core.processes import Stop
from photonfarm.shared.core.waiting import pause_after_look
from photonfarm.shared.store.write.lease import LeasedError
from photonfarm.trainer.data.feed import SampleSource

LOOK_S = 2.0
"""The seconds between two looks for a lease, or more where a look takes long."""


class Presence:
    """A context manager: at its end the trainer is no longer at work in the scene."""

    def __init__(self, source: SampleSource, what: str, tell: Callable[[str], object]) -> None:
        """Nothing is announced yet. `tell` gets a sentence when somebody else has the scene for itself."""
        self._source, self._what, self._tell = source, what, tell
        self._announced = ExitStack()
        self._due = 0.0
        self.is_there = False  # announced as at work

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def begin(self, stop: Stop, is_over: Callable[[], bool]) -> bool:
        """Announce it as soon as nobody has the scene for itself; False if it is stopped or over before that."""
        said = ""
        while not self.is_there:
            try:
                self._announced.enter_context(self._source.at_work(self._what))
                self.is_there = True
            except LeasedError as error:
                if str(error) != said:
                    self._tell(f"training waits: {error}")
                said = str(error)
                if stop.wait(LOOK_S) or is_over():
                    break
        return self.is_there

    def end(self) -> None:
        """End it: whoever has the lease may begin."""
        self._announced.close()
        self.is_there = False

    def is_to_end(self) -> bool:
        """Whether somebody has taken the lease, by a look now and then."""
        if (began := time.monotonic()) < self._due:
            return False
        found = self._source.lease() is not None
        self._due = (now := time.monotonic()) + pause_after_look(now - began, LOOK_S)
        return found
