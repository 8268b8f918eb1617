"""Something to read while something takes long, and spans of time in words."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

EVERY_S = 4.0


@contextmanager
def waiting(log: Callable[[str], None], what: str, every_s: float = EVERY_S) -> Iterator[None]:
    """Say what is done, and every few seconds for how long it has been, until the block ends."""
    began, done = time.monotonic(), threading.Event()

    def say() -> None:
        while not done.wait(every_s):
            log(f"{what}: {time.monotonic() - began:.0f} s so far")

    log(what)
    teller = threading.Thread(target=say, daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()
        teller.join()


def in_words(seconds: float) -> str:
    """A span of time as people say it: 45 s, 12 min, 3.4 h, 2.1 days."""
    if seconds < 100:
        return f"{max(seconds, 0):.0f} s"
    if seconds < 5940:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} days"
