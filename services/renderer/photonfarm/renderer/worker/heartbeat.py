"""A worker's heartbeat and a job's deadline, both kept by threads that rendering does not block."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import threading
from collections.abc import Iterator, Mapping

import redis

from photonfarm.renderer.worker.settings import JOB_IN_HAND, WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.core.processes import process_space
from photonfarm.shared.store import Store

STDERR = 2

REPORT_S = 2.0
"""The seconds between two reports of what the worker is doing."""


@contextlib.contextmanager
def in_hand(settings: WorkerSettings, pipe: int | None, name: str) -> Iterator[None]:
    """Tell the supervisor of a job that the block renders; past the deadline the process ends, and prints where."""
    if pipe is not None:
        with contextlib.suppress(BrokenPipeError):
            os.write(pipe, f"{JOB_IN_HAND}{name}\n".encode())
    # its watchdog is a thread without Python's lock, so that it also ends native code that never returns
    faulthandler.dump_traceback_later(settings.deadline_s, exit=True, file=STDERR if pipe is None else pipe)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class HeartbeatThread:
    """Writes the heartbeat of the worker and its job, and why it is idle, from a thread with its own connection.

    `paused` is the reason why it takes no jobs, and `left` by scene id the reason why it skips scenes for now.
    """

    def __init__(self, settings: WorkerSettings, store: Store, pipe: int | None) -> None:
        """Connect; `pipe` is a file descriptor for the supervisor. Raises QueueError if there is no Redis."""
        self._settings = settings
        self._store = store
        self._pipe = pipe
        self._connection = queue.connect(settings.queue_url)
        self._supervisor = os.getppid()
        self._job: str | None = None
        self._ended = threading.Event()
        self.paused: str | None = None
        self.left: Mapping[str, str] = {}  # replaced, never changed
        self._left_reported: Mapping[str, str] = {}
        self._activity: queue.Activity | None = None  # replaced, never changed

    def start(self) -> None:
        """Take over from a child that died, and beat for as long as the process lives."""
        queue.free_job(self._connection, self._settings.name)
        self._beat()
        for keep in (self._keep_beating, self._keep_reporting):
            threading.Thread(target=keep, daemon=True).start()

    def doing(self, phase: str, done: int = 0, total: int = 0) -> None:
        """Note what the worker is doing; it is reported soon. See `jobs.OnProgress`."""
        self._activity = queue.Activity(phase, done, total, self._job)

    def end(self) -> None:
        """Remove the heartbeat of the worker's child; its supervisor keeps the name."""
        self._ended.set()
        queue.free_job(self._connection, self._settings.name)
        queue.clear_idle_report(self._connection, self._settings.name, {*self.left, *self._left_reported})
        queue.clear_activity(self._connection, self._settings.name)

    @contextlib.contextmanager
    def working(self, name: str) -> Iterator[None]:
        """Beat for a job too while the block runs; past the deadline the process ends, and prints where it hung."""
        self._job = name
        self._beat()
        try:
            with in_hand(self._settings, self._pipe, name):
                yield
        finally:
            self._job = self._activity = None
            with contextlib.suppress(redis.RedisError):
                self._connection.delete(queue.ALIVE + name)

    def _keep_beating(self) -> None:
        while not self._ended.wait(self._settings.heartbeat_ttl_s / 5):
            with contextlib.suppress(redis.RedisError, QueueError):  # an outage is noticed where the job ends
                self._beat()
                queue.serve(self._connection, self._store)

    def _keep_reporting(self) -> None:
        """Report what the worker does every few seconds, and why it is idle as soon as that changes."""
        reported, idle = None, (self.paused, self.left)
        while not self._ended.wait(REPORT_S):
            now, before, idle = self._activity, idle, (self.paused, self.left)
            with contextlib.suppress(redis.RedisError, QueueError):
                if idle != before:
                    self._beat()
                if now is not None:
                    queue.report_activity(
                        self._connection, self._settings.name, now, ttl_s=self._settings.heartbeat_ttl_s
                    )
                elif reported is not None:
                    queue.clear_activity(self._connection, self._settings.name)
                reported = now

    def _beat(self) -> None:
        name, ttl_s = self._settings.name, self._settings.heartbeat_ttl_s
        queue.beat(self._connection, name, process_space(), self._job, ttl_s=ttl_s, process=self._supervisor)
        left, self._left_reported = self._left_reported, self.left
        if no_longer := left.keys() - self._left_reported.keys():
            queue.clear_idle_report(self._connection, name, no_longer)
        queue.report_idle(self._connection, name, self.paused, self._left_reported, ttl_s=ttl_s)
