"""What a supervisor tells Redis of its worker, and of jobs that end with its child; without Redis, the store alone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import redis

from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.queue.rq_adapter import fail_of_worker
from photonfarm.shared.store import Store


class Registration:
    """A worker as others know it: in Redis, or, with a share, nowhere."""

    def __init__(self, settings: WorkerSettings) -> None:
        """Connect; raises QueueError if the worker needs a Redis and there is none."""
        self._ttl_s = settings.heartbeat_ttl_s
        self._connection = None if settings.share is not None else queue.connect(settings.queue_url)

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()

    def serve(self, store: Store) -> None:
        """Register the store that the worker serves. Raises QueueError if another one is served."""
        if self._connection is not None:
            queue.serve(self._connection, store)

    @contextlib.contextmanager
    def named(self, wanted: str) -> Iterator[str]:
        """Hold a name that no other live worker has, until the block ends. Raises QueueError."""
        if self._connection is None:
            yield wanted
            return
        with queue.redis_errors(f"told of worker {wanted}"):
            name = queue.take_name(self._connection, wanted, ttl_s=self._ttl_s)
            fail_of_worker(self._connection, name, "its worker was killed", counts=True)  # that of a predecessor
        try:
            yield name
        finally:
            with contextlib.suppress(redis.RedisError):
                queue.bury(self._connection, name)

    def beat(self, name: str) -> None:
        """Count as alive while there is no child, unless Redis fails."""
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError), self._connection.pipeline() as pipeline:
                queue.beat(pipeline, name, queue.WorkerReport(), ttl_s=self._ttl_s)
                pipeline.execute()

    def ended(self, store: Store, name: str, lost: str | None, how: str) -> None:
        """Free at once what a child had in hand when it ended; the job that is `lost` was tried, and is kept as failed.

        A job of a child that was to stop, or that has ended and could not tell Redis, counts as no try.
        """
        if lost is not None:
            with contextlib.suppress(OSError):
                queue.keep_failure(store, lost, how, worker=name)
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError):
                fail_of_worker(self._connection, name, how, counts=lost is not None)
            self.beat(name)

    def release(self, store: Store) -> None:
        """End the registration of the store if this was its last worker, unless Redis fails."""
        if self._connection is not None:
            with contextlib.suppress(redis.RedisError):
                queue.release(self._connection, store)
