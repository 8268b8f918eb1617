"""Where a worker's jobs come from: an interface, which the queue and a share of the store's missing jobs implement."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Literal

from photonfarm.queue import Activity, RenderArguments

Ending = Literal["done", "again", "failed"]
"""What a job came to: there is nothing left to do; it is put back, and was no try; or it was a try."""


class TakenError(Exception):
    """Another worker has committed the job in hand."""


class JobSource(ABC):
    """Where a worker's jobs come from, and where it tells what they come to.

    Methods raise StoreError, QueueError or redis.RedisError.
    """

    pause_s: float = 0.0
    """How long to wait after `take` has found nothing."""

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Tell others of the worker until the block ends."""
        yield

    def ahead(self) -> Mapping[str, str]:
        """The scenes of which no job should be taken now: the reason, by scene id."""
        return {}

    @abstractmethod
    def take(self, paused: str | None, left: Mapping[str, str]) -> RenderArguments | None:
        """The next job of the scenes that are not `left`; None if there is none now, or the worker is `paused`.

        Both have reasons, `left` by scene id.
        """

    @abstractmethod
    def tell_doing(self, doing: Activity) -> None:
        """Tell what the worker does with the job in hand; raises TakenError if that is of no use any more."""

    @abstractmethod
    def end(self, name: str, ending: Ending, reason: str) -> bool:
        """Tell what the job in hand has come to; returns whether it is set aside now."""

    @abstractmethod
    def has_more(self, *, may_leave: bool) -> bool:
        """Whether there will be more to take, after nothing was; `may_leave`: what others have to do does not count."""

    @abstractmethod
    def set_aside(self) -> Mapping[str, str]:
        """Why jobs are not tried any more, by their names."""
