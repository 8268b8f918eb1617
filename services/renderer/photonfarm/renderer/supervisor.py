"""The supervisor: starts the worker's child again whenever it ends, until there is nothing left to do."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

import redis

from photonfarm.renderer.worker_settings import GRACE_S, RECYCLED, WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.errors import BackendError, IncompleteError, QueueError, StoreError

BACKOFF_S = (0.1, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)


class Supervisor:
    """Starts the child again until it has nothing left to do."""

    def __init__(self, settings: WorkerSettings, command: tuple[str, ...], say: Callable[[str], None]) -> None:
        """Take what to start, and where to say what happens."""
        self._settings = settings
        self._command = command
        self._say = say
        self._stop = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        """Supervise; raises what the child cannot go on with."""
        with self._signals():
            failures = 0
            while not self._stop.is_set():
                started = time.monotonic()
                code, message = self._run_child()
                if code < 0 and self._stop.is_set():
                    _free_job(self._settings)
                if code == 0 or self._stop.is_set():
                    return
                _raise_final(code, message)
                if code == RECYCLED:
                    failures = 0
                    continue
                failures = 0 if time.monotonic() - started > self._settings.steady_s else failures
                pause = BACKOFF_S[min(failures, len(BACKOFF_S) - 1)]
                failures += 1
                self._say(f"worker {self._settings.name}: {_ending(code, message)}; starting again in {pause:g} s")
                self._stop.wait(pause)

    def _run_child(self) -> tuple[int, str]:
        """Exit code of one child, and its last words."""
        with subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        ) as self._child:
            if self._child.stdin is None or self._child.stdout is None:
                raise BackendError("the worker's child was started without pipes")
            if self._stop.is_set():  # asked to while it was being started
                self._child.terminate()
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.write(self._settings.model_dump_json().encode() + b"\n")
                self._child.stdin.flush()  # and left open: its end tells the child that we are gone
            words = self._child.stdout.read().decode(errors="replace").strip()
            return self._child.wait(), words.splitlines()[-1] if words else ""

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        again = self._stop.is_set()
        self._stop.set()
        if self._child is not None:
            self._child.send_signal(signal.SIGKILL if again else signal.SIGTERM)
        if not again:
            threading.Thread(target=self._see_off, daemon=True).start()

    def _see_off(self) -> None:
        """End the child after the grace: its own handler waits for native code to return, which may take minutes."""
        self._say(
            f"worker {self._settings.name}: stopping; a job in hand that takes longer than {GRACE_S:g} s "
            "will be rendered again"
        )
        time.sleep(GRACE_S)
        if self._child is not None:
            self._child.kill()


def _free_job(settings: WorkerSettings) -> None:
    """Let others have the job that a child was killed with at once, and do not count this start of it."""
    with contextlib.suppress(QueueError, redis.RedisError), queue.connect(settings.redis_url) as connection:
        name = queue.bury(connection, settings.name)
        if name is not None:
            connection.delete(queue.STARTS + name)


def _raise_final(code: int, message: str) -> None:
    """Raise what starting again does not help against."""
    for kind in (StoreError, BackendError, IncompleteError):
        if code == kind.exit_code:
            raise kind(message)


def _ending(code: int, message: str) -> str:
    if code < 0:
        return f"its child was ended by {signal.Signals(-code).name}"
    return message or f"its child ended with exit code {code}, for the reason above"
