"""Child processes that end with their parent, requests to stop, and the scope of process numbers.

Verbs of `photonfarm` run as child processes.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_LAUNCH = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: end with the process that started us
    if os.getppid() != int(sys.argv[1]):
        sys.exit(1)  # that process has ended already
os.execv(sys.argv[2], sys.argv[2:])
"""


def tie(command: Sequence[str]) -> list[str]:
    """The command, wrapped so that on Linux it gets SIGTERM when this process ends; the main thread must start it."""
    return [sys.executable, "-c", _LAUNCH, str(os.getpid()), *command]


@contextmanager
def end_on_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C end this process at once, also inside native code, until which Python's own handler would wait.

    For work that keeps nothing before its end; anywhere but in the main thread it changes nothing.
    """
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def loading() -> Iterator[None]:
    """Load a verb's packages within the block, for less processor time; for once in a process.

    Garbage is not looked for meanwhile, and never among what there is then: loading makes hardly any, and what is
    loaded stays.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()


@contextmanager
def repeat(every_s: float, do: Callable[[], object]) -> Iterator[None]:
    """Do something every few seconds, in a thread of its own, until the block ends."""
    ended = threading.Event()

    def keep_doing() -> None:
        while not ended.wait(every_s):
            do()

    thread = threading.Thread(target=keep_doing, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def usable_cores() -> int:
    """The number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_port(wanted: int = 0) -> int:
    """A TCP port of this machine that nobody listens on: the wanted one if it is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do; a listening one still refuses
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


NAP_S = 0.1  # the longest delay until a `Stop` is noticed


class Stop:
    """A request to stop, which signal handlers may set: like `threading.Event`, but without a lock.

    A handler may interrupt the main thread anywhere, even inside of another handler. If the main thread holds the lock
    of an event at that moment, in `set` or at the beginning of `wait`, the handler's own `set` would wait forever.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Request a stop."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether a stop has been requested."""
        return self._is_set

    def wait(self, seconds: float) -> bool:
        """Wait for the request, at most so many seconds; returns whether there is one."""
        end = time.monotonic() + seconds
        while not self._is_set and (left := end - time.monotonic()) > 0:
            time.sleep(min(left, NAP_S))
        return self._is_set


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """A `Stop` that SIGTERM and SIGINT set, unless this is not the main thread, which gets signals."""
    stop = Stop()
    names = (signal.SIGTERM, signal.SIGINT) if threading.current_thread() is threading.main_thread() else ()
    before = [signal.signal(name, lambda *_: stop.set()) for name in names]
    try:
        yield stop
    finally:
        for name, handler in zip(names, before, strict=True):
            signal.signal(name, handler)


def is_gone(process: int) -> bool:
    """Whether no process of this machine, or container, has that number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


@cache
def process_space() -> str:
    """The scope in which process numbers are unique: containers may share a host's name, but not its processes."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()[:8]
        space = f"{boot}{Path('/proc/self/ns/pid').stat().st_ino:x}"
    except OSError:  # not Linux, hence no containers: the host's name must do
        space = "0"
    return f"{socket.gethostname()}-{space}"


GROUP = "photonfarm.commands"
"""The group of entry points that holds all verbs."""


def can_render() -> bool:
    """Whether Mitsuba is installed here, which all verbs of the renderer need."""
    return find_spec("mitsuba") is not None


def command(*arguments: str | Path) -> list[str]:
    """The command line of a verb with its arguments, for a child process: this Python runs it, whatever is on PATH."""
    return [sys.executable, "-m", "photonfarm.cli", *map(str, arguments)]
