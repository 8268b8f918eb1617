"""Jobs from the queue in Redis, where others see what this worker does."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace

import redis

from photonfarm import queue
from photonfarm.core.errors import QueueError
from photonfarm.core.processes import Stop
from photonfarm.queue import Activity, RenderArguments, rq_adapter
from photonfarm.renderer.worker.backpressure import TrainerPace
from photonfarm.renderer.worker.heartbeat import heartbeat
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.renderer.worker.source import Ending, JobSource
from photonfarm.store import Store

POLL_S = 0.2
"""The seconds between looks at an empty queue."""


class QueueSource(JobSource):
    """Takes jobs from the queue, and fills it from the store when it is empty."""

    def __init__(self, settings: WorkerSettings, store: Store, stop: Stop) -> None:
        """Connect; raises QueueError if there is no Redis."""
        self._settings, self._store, self._stop = settings, store, stop
        self._connection = queue.connect(settings.queue_url)
        self._queue = rq_adapter.open_queue(self._connection)
        self._ttl_s = max(1, int(settings.heartbeat_ttl_s))
        self._report = queue.WorkerReport(process=os.getppid())  # replaced, never changed
        self._execution: rq_adapter.Execution | None = None
        self._ending = threading.Lock()  # no heartbeat follows the end of a job
        self._pace = (
            None
            if settings.ahead is None
            else TrainerPace(store, self._connection, settings.ahead, scene_id=settings.scene_id)
        )

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Keep the worker and its job alive until the block ends."""
        self._beat()
        with heartbeat(self._beat, self._ttl_s):
            yield

    def _beat(self) -> None:
        with contextlib.suppress(redis.RedisError, QueueError):  # an outage is noticed where a job is taken or ends
            with self._ending, self._connection.pipeline() as pipeline:
                queue.beat(pipeline, self._settings.name, self._report, ttl_s=self._ttl_s)
                if self._execution is not None:
                    rq_adapter.keep_alive(self._queue, self._execution, pipeline, self._ttl_s)
                pipeline.execute()
            queue.serve(self._connection, self._store)

    def ahead(self) -> Mapping[str, str]:
        """The scenes whose trainers are far behind."""
        return {} if self._pace is None else self._pace.ahead()

    def tell_doing(self, doing: Activity) -> None:
        """Tell it with the next heartbeat."""
        self._report = replace(self._report, doing=doing)

    def take(self, paused: str | None, left: Mapping[str, str]) -> RenderArguments | None:
        """The next job in the queue; None if there was none for a while. Reasons are told with the next heartbeat."""
        self._report = replace(self._report, paused=paused, left=left)
        queue.serve(self._connection, self._store)
        until = time.monotonic() + self._settings.idle_s
        while not (paused or self._stop.is_set()):
            self._execution = rq_adapter.take(
                self._queue, self._settings.name, ttl_s=self._ttl_s, scene_id=self._settings.scene_id, leave=left.keys()
            )
            if self._execution is not None or time.monotonic() >= until:
                break
            self._stop.wait(self._settings.idle_s if left else POLL_S)  # each look passes all jobs that are left
        return None if self._execution is None else RenderArguments.of(self._execution.job_id)

    def end(self, name: str, ending: Ending, reason: str) -> bool:
        """Tell the queue, and keep a failure in the store too; Redis may forget it."""
        if ending == "failed":
            with contextlib.suppress(OSError):
                queue.keep_failure(self._store, name, reason, worker=self._settings.name)
        with self._ending:
            execution, self._execution = self._execution, None
            self._report = replace(self._report, doing=None)
            if execution is None:
                return False
            if ending == "done":
                rq_adapter.finish(self._queue, execution)
                return False
            return rq_adapter.fail(self._queue, execution, reason, counts=ending == "failed")

    def has_more(self, *, may_leave: bool) -> bool:
        """Whether something was missing and is queued now, or is in the hands of others."""
        found = queue.fill_seldom(
            self._store, self._connection, scene_id=self._settings.scene_id, every_s=self._settings.idle_s
        )
        return found == "queued" or (found == "waits" and not may_leave)

    def set_aside(self) -> Mapping[str, str]:
        """Why jobs failed too often."""
        return {name: failure.reason for name, failure in queue.queue_status(self._connection).failed.items()}
