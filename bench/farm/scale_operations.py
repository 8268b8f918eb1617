"""Counts of what is asked of a store, by watching the methods of its storage; and the memory of this process."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

METHODS = ("read", "exists", "size", "names", "local", "adopt", "adopt_folder")
"""The methods of `storage.Storage` that are counted."""


@contextlib.contextmanager
def counted(storage: type) -> Iterator[Counter[str]]:
    """Count the calls, the bytes read and the names listed of all storages of a class, within the block."""
    counts: Counter[str] = Counter()
    lock, before = threading.Lock(), {method: getattr(storage, method) for method in METHODS}

    def watched(method: str) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            result = before[method](*given, **named)
            with lock:
                counts[method] += 1
                if method == "read":
                    counts["read_bytes"] += len(result)
                elif method == "names":
                    counts["names_listed"] += len(result)
            return result

        return call

    for method in METHODS:
        setattr(storage, method, watched(method))
    try:
        yield counts
    finally:
        for method in METHODS:
            setattr(storage, method, before[method])


def resident_bytes() -> int:
    """The memory that this process holds now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def forget_peak() -> None:
    """Let `peak_bytes` begin anew (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """The most memory that this process has held, since `forget_peak`."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024


def processor_s() -> float:
    """The processor time of this process, all threads."""
    return time.process_time()
