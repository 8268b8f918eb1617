"""Processes that end with the one that started them."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

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
