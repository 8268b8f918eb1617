"""A worker's heartbeat and a job's deadline, both kept by threads that no rendering holds up."""

from __future__ import annotations

import contextlib
import faulthandler
import socket
import threading
from collections.abc import Iterator

import redis

from photonfarm.renderer.worker_settings import WorkerSettings
from photonfarm.shared import queue


class Heart:
    """Tells Redis that the worker and its job are alive, from a thread with a connection of its own."""

    def __init__(self, settings: WorkerSettings) -> None:
        """Connect; raises QueueError if there is no Redis."""
        self._settings = settings
        self._connection = queue.connect(settings.redis_url)
        self._job: str | None = None
        self._ended = threading.Event()

    def start(self) -> None:
        """Take over from a child that died, and beat for as long as the process lives."""
        queue.bury(self._connection, self._settings.name)
        self._beat()
        threading.Thread(target=self._keep_beating, daemon=True).start()

    def end(self) -> None:
        """Say that the worker is gone."""
        self._ended.set()
        queue.bury(self._connection, self._settings.name)

    @contextlib.contextmanager
    def working(self, name: str) -> Iterator[None]:
        """Beat for a job too while the block runs; past the deadline the process ends, and says where it hung."""
        self._job = name
        self._beat()
        # its watchdog is a thread without Python's lock, so that native code that never returns is ended as well
        faulthandler.dump_traceback_later(self._settings.deadline_s, exit=True)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            self._job = None
            with contextlib.suppress(redis.RedisError):
                self._connection.delete(queue.ALIVE + name)

    def _keep_beating(self) -> None:
        while not self._ended.wait(self._settings.heartbeat_ttl_s / 5):
            with contextlib.suppress(redis.RedisError):  # an outage is noticed where the job ends
                self._beat()

    def _beat(self) -> None:
        queue.beat(
            self._connection,
            self._settings.name,
            socket.gethostname(),
            self._job,
            ttl_s=self._settings.heartbeat_ttl_s,
        )
