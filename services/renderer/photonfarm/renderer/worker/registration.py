"""Where a worker is known by its name, and its jobs that ended with its child: in Redis, or in the store alone."""

from __future__ import annotations

import contextlib
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator

import redis

from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.core.processes import process_space
from photonfarm.shared.store import Store


class Registration(ABC):
    """What a supervisor tells others of its worker."""

    @abstractmethod
    def serve(self, store: Store) -> None:
        """Register the store that the worker serves. Raises QueueError if another one is served."""

    @abstractmethod
    def named(self, wanted: str) -> contextlib.AbstractContextManager[str]:
        """Hold a name that no other live worker has, until the block ends. Raises QueueError."""

    @abstractmethod
    def beat(self, name: str) -> None:
        """Keep counting as alive while there is no child."""

    @abstractmethod
    def stopped(self, name: str) -> None:
        """Free the job of a child that was killed on request, and do not count this start of it."""

    @abstractmethod
    def lost(self, store: Store, name: str, job: str, ending: str, *, overdue: bool) -> None:
        """Count the end of a child in the middle of a job, for which nobody asked."""

    @abstractmethod
    def release(self, store: Store) -> None:
        """End the registration of the store if this was its last worker."""


@contextlib.contextmanager
def registration(settings: WorkerSettings) -> Iterator[Registration]:
    """The registration of a worker until the block ends; raises QueueError if it needs a Redis and there is none."""
    if settings.share is not None:
        yield StoreRegistration()
        return
    with queue.connect(settings.queue_url) as connection:
        yield RedisRegistration(settings, connection)


class RedisRegistration(Registration):
    """A worker and its lost jobs, known in Redis by heartbeats."""

    def __init__(self, settings: WorkerSettings, connection: redis.Redis) -> None:
        """Take the connection for what must not fail; the rest has one of its own each time."""
        self._settings = settings
        self._connection = connection

    def serve(self, store: Store) -> None:
        """Register the store in Redis."""
        queue.serve(self._connection, store)

    @contextlib.contextmanager
    def named(self, wanted: str) -> Iterator[str]:
        """Hold the name, or with a number behind it while another worker has it."""
        try:
            name = queue.take_name(
                self._connection, wanted, process_space(), os.getpid(), ttl_s=self._settings.heartbeat_ttl_s
            )
        except redis.RedisError as error:
            raise QueueError(f"Redis failed while worker {wanted} was announced: {error}") from error
        try:
            yield name
        finally:
            with contextlib.suppress(redis.RedisError):
                queue.bury(self._connection, name)

    def beat(self, name: str) -> None:
        """Beat, unless Redis fails."""
        with contextlib.suppress(redis.RedisError):
            queue.beat(
                self._connection, name, process_space(), None, ttl_s=self._settings.heartbeat_ttl_s,
                process=os.getpid(),
            )  # fmt: skip

    def stopped(self, name: str) -> None:
        """Free the job at once."""
        with contextlib.suppress(QueueError, redis.RedisError), queue.connect(self._settings.queue_url) as connection:
            job = queue.free_job(connection, name)
            if job is not None:
                queue.forget_starts_of(connection, job)

    def lost(self, store: Store, name: str, job: str, ending: str, *, overdue: bool) -> None:  # noqa: ARG002
        """Count what the deadline ended; other ends are counted by the starts."""
        if not overdue:
            return
        with contextlib.suppress(QueueError, redis.RedisError), queue.connect(self._settings.queue_url) as connection:
            queue.count_overdue(connection, job)

    def release(self, store: Store) -> None:
        """Free this Redis for another store, unless it fails."""
        with contextlib.suppress(redis.RedisError):
            queue.release(self._connection, store)


class StoreRegistration(Registration):
    """Nowhere: only the store knows the worker, by what it commits, and by failures."""

    def serve(self, store: Store) -> None:
        """Do nothing: nobody shares anything else."""

    @contextlib.contextmanager
    def named(self, wanted: str) -> Iterator[str]:
        """Take the name as it is."""
        yield wanted

    def beat(self, name: str) -> None:
        """Do nothing: nobody listens."""

    def stopped(self, name: str) -> None:
        """Do nothing: a job without a marker is missing."""

    def lost(self, store: Store, name: str, job: str, ending: str, *, overdue: bool) -> None:  # noqa: ARG002
        """Keep it as a failure: nothing else would count it, and the job would end one worker after the other."""
        with contextlib.suppress(OSError):
            queue.keep_failure(store, job, ending, worker=name, at_s=time.time())

    def release(self, store: Store) -> None:
        """Do nothing."""
