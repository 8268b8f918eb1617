"""What RQ's SimpleWorker lacks while a job is in hand: a heartbeat, and a deadline that also ends native code."""

from __future__ import annotations

import contextlib
import faulthandler
from collections.abc import Callable, Iterator

from photonfarm.core.processes import repeat
from photonfarm.renderer.worker.outcomes import send_line
from photonfarm.renderer.worker.settings import JOB_IN_HAND, WorkerSettings

STDERR = 2

REPORT_S = 2.0
"""The most seconds between two heartbeats, which also tell what the worker does."""


def heartbeat(beat: Callable[[], object], ttl_s: float) -> contextlib.AbstractContextManager[None]:
    """Beat until the block ends, in a thread that rendering does not block, well before `ttl_s` are over."""
    return repeat(min(REPORT_S, ttl_s / 5), beat)


@contextlib.contextmanager
def deadline(settings: WorkerSettings, pipe: int | None, name: str) -> Iterator[None]:
    """Tell the supervisor of a job that the block renders; past the deadline the process ends, and prints where."""
    if pipe is not None:
        send_line(pipe, f"{JOB_IN_HAND}{name}")
    # its watchdog is a thread without Python's lock, so that it also ends native code that never returns
    faulthandler.dump_traceback_later(settings.deadline_s, exit=True, file=STDERR if pipe is None else pipe)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
