"""Processes that end with the one that started them or when asked to, and where the number of one means something."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path

_LAUNCH = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: end with the process that started us…
    if os.getppid() != int(sys.argv[1]):
        sys.exit(1)  # …which has ended already
os.execv(sys.argv[2], sys.argv[2:])
"""


def tied(command: Sequence[str]) -> list[str]:
    """The command, to be started by the main thread: on Linux it gets SIGTERM when we end, however we do."""
    return [sys.executable, "-c", _LAUNCH, str(os.getpid()), *command]


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


NAP_S = 0.1  # at the longest, until a `Stop` is noticed


class Stop:
    """Set by a signal's handler: `threading.Event` without its lock.

    A handler interrupts the main thread anywhere, in another handler too. If that holds the event's lock, in `set` or
    at the beginning of `wait`, the handler's `set` waits for ever.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Ask to stop."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether somebody has."""
        return self._is_set

    def wait(self, seconds: float) -> bool:
        """Wait for it so long at most; whether somebody has asked."""
        end = time.monotonic() + seconds
        while not self._is_set and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, NAP_S))
        return self._is_set


@cache
def process_space() -> str:
    """Where process numbers mean what they mean here: containers may share a host's name, but not its processes."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()[:8]
        space = f"{boot}{Path('/proc/self/ns/pid').stat().st_ino:x}"
    except OSError:  # not Linux, hence no containers: the host's name must do
        space = "0"
    return f"{socket.gethostname()}-{space}"
