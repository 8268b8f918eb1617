"""Where a worker's jobs come from, and where it tells what they come to: the queue, or a share of what the store lacks.

With a queue, others see what this worker does, and no two workers take one job. A share needs no Redis: the store alone
is truth. A worker looks up what is missing now and then, and each job once more before it is rendered, and after its
share takes what is left. Nobody reserves a job, so two workers may render the same one at the end. The one that learns
of the other's commit gives its own up.

Both sources have the same methods, which raise StoreError, QueueError or redis.RedisError.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal

import redis

from photonfarm.core.errors import QueueError, StoreError, store_errors
from photonfarm.core.processes import Stop, repeat
from photonfarm.core.waiting import pause_after_look
from photonfarm.queue import rq_adapter
from photonfarm.queue.connection import connect
from photonfarm.queue.failures import count_failures, keep_failure, read_kept_failures
from photonfarm.queue.job import TRIES, RenderArguments, Share, job_name
from photonfarm.queue.reconciliation import fill_seldom
from photonfarm.queue.workers import Activity, WorkerReport, beat, serve
from photonfarm.renderer.worker.backpressure import TrainerPace
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.store import Store

LOOK_S = 30.0
"""The seconds after which the markers are looked at again; in between a job costs one question to the store.

Where a look takes long, it is done more rarely, as `pause_after_look` says.
"""

TAKEN_LOOK_S = 2.0
"""The seconds between two looks whether another worker has committed the job in hand."""

POLL_S = 0.2
"""The seconds between looks at an empty queue."""

REPORT_S = 2.0
"""The most seconds between two heartbeats, which also tell what the worker does."""

log = logging.getLogger(__name__)

Ending = Literal["done", "again", "failed"]
"""What a job came to: there is nothing left to do; it is put back, and was no try; or it was a try."""


class TakenError(Exception):
    """Another worker has committed the job in hand."""


class QueueSource:
    """Takes jobs from the queue, and fills it from the store when it is empty."""

    pause_s = 0.0  # after `take` has found nothing

    def __init__(self, settings: WorkerSettings, store: Store, stop: Stop) -> None:
        """Connect; raises QueueError if there is no Redis."""
        self._settings, self._store, self._stop = settings, store, stop
        self._connection = connect(settings.queue_url)
        self._queue = rq_adapter.open_queue(self._connection)
        self._ttl_s = max(1, int(settings.heartbeat_ttl_s))
        self._report = WorkerReport(process=os.getppid())  # replaced, never changed
        self._execution: rq_adapter.Execution | None = None
        self._ending = threading.Lock()  # no heartbeat follows the end of a job
        self._pace = settings.ahead and TrainerPace(store, self._connection, settings.ahead, scene_id=settings.scene_id)

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Keep the worker and its job alive until the block ends."""
        self._beat()
        with repeat(min(REPORT_S, self._ttl_s / 5), self._beat):  # in a thread that rendering does not block
            yield

    def _beat(self) -> None:
        with contextlib.suppress(redis.RedisError, QueueError):  # an outage is noticed where a job is taken or ends
            with self._ending, self._connection.pipeline() as pipeline:
                beat(pipeline, self._settings.name, self._report, ttl_s=self._ttl_s)
                if self._execution is not None:
                    rq_adapter.keep_alive(self._queue, self._execution, pipeline, self._ttl_s)
                pipeline.execute()
            serve(self._connection, self._store)

    def scenes_ahead(self) -> Mapping[str, str]:
        """The scenes whose trainers are far behind, so that no job of them should be taken: the reason, by scene id."""
        return self._pace.scenes_ahead() if self._pace else {}

    def take(self, paused: str | None, left: Mapping[str, str]) -> RenderArguments | None:
        """The next job of the scenes that are not `left`; None if there was none for a while, or while `paused`.

        Both have reasons, `left` by scene id, which are told with the next heartbeat.
        """
        self._report = replace(self._report, paused=paused, left=left)
        serve(self._connection, self._store)
        until = time.monotonic() + self._settings.idle_s
        while not (paused or self._stop.is_set()):
            self._execution = rq_adapter.take(
                self._queue, self._settings.name, ttl_s=self._ttl_s, scene_id=self._settings.scene_id, leave=left.keys()
            )
            if self._execution is not None or time.monotonic() >= until:
                break
            self._stop.wait(self._settings.idle_s if left else POLL_S)  # each look passes all jobs that are left
        return None if self._execution is None else RenderArguments.of(self._execution.job_id)

    def tell_doing(self, doing: Activity) -> None:
        """Tell what the worker does with the job in hand, with the next heartbeat."""
        self._report = replace(self._report, doing=doing)

    def end(self, name: str, ending: Ending, reason: str) -> bool:
        """Tell what the job in hand has come to, and keep a failure in the store too; whether the job is set aside."""
        if ending == "failed":
            with contextlib.suppress(OSError):
                keep_failure(self._store, name, reason, worker=self._settings.name)
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
        """Whether something was missing and is queued now, or unless the worker `may_leave` is in others' hands."""
        state = fill_seldom(
            self._store, self._connection, scene_id=self._settings.scene_id, every_s=self._settings.idle_s
        )
        return state == "queued" or (state == "waits" and not may_leave)

    def set_aside(self) -> Mapping[str, str]:
        """Why jobs failed too often, by their names."""
        return {name: failure.reason for name, failure in rq_adapter.read_failures(self._queue).items()}


class ShareSource:
    """Takes the jobs of a share, and then others."""

    def __init__(self, settings: WorkerSettings, store: Store, share: Share) -> None:
        """Look at nothing yet."""
        self._settings, self._store, self._share = settings, store, share
        self._waiting: deque[RenderArguments] = deque()  # in the order in which they are taken
        self._look_due = self._taken_look_due = 0.0
        self.pause_s: float = settings.idle_s  # between looks that find nothing
        self._unreadable: Mapping[str, StoreError] = {}
        self._in_hand: RenderArguments | None = None

    def open(self) -> contextlib.nullcontext[None]:
        """Nobody is told of the worker."""
        return contextlib.nullcontext()

    def scenes_ahead(self) -> Mapping[str, str]:
        """Nothing: without Redis no trainer is known."""
        return {}

    def take(self, paused: str | None, left: Mapping[str, str]) -> RenderArguments | None:
        """The next job that is still missing, of the scenes that are not `left`; None without one or while `paused`."""
        looked = bool(paused)
        while not looked:  # what was left at the last look may have been rendered by others
            if looked := not self._waiting or time.monotonic() >= self._look_due:
                self._list_missing()
            while self._waiting:
                job = self._waiting.popleft()
                if job.scene_id not in left and self._store.scene(job.scene_id).is_to_do(job.job):
                    self._in_hand, self._taken_look_due = job, time.monotonic() + TAKEN_LOOK_S
                    return job
        return None

    def _list_missing(self) -> None:
        """List what is missing, without what has failed too often; what has failed comes last."""
        self._store.check()
        began, wanted = time.monotonic(), self._settings.scenes
        scenes = wanted
        if not self._settings.until_complete:  # a worker that waits for more lets the scenes come later
            scenes = tuple(filter(self._store.has_scene, wanted))
        none_is_there = wanted and not scenes
        missing, unreadable = ({}, {}) if none_is_there else missing_jobs(self._store, scenes, followed=True)
        self.pause_s = pause_after_look(time.monotonic() - began, self._settings.idle_s)
        for scene_id in unreadable.keys() - self._unreadable.keys():
            log.warning("scene %s is passed over, and the others go on: %s", scene_id, unreadable[scene_id])
        self._unreadable = unreadable
        with store_errors("look for failures", self._store.storage.where):
            times = count_failures(self._store)
        candidates = [
            (times.get(job_name(scene_id, job), 0), not self._share.owns(job), RenderArguments(scene_id, job))
            for scene_id, jobs in missing.items()
            for job in self._share.order(jobs)
        ]
        candidates.sort(key=lambda each: each[:2])
        self._waiting = deque(job for failed, _, job in candidates if failed < TRIES)
        self._look_due = time.monotonic() + max(LOOK_S, self.pause_s)

    def tell_doing(self, doing: Activity) -> None:  # noqa: ARG002 - nobody listens
        """Give the job in hand up if another worker has committed it: raises TakenError."""
        if self._in_hand is None or time.monotonic() < self._taken_look_due:
            return
        self._taken_look_due = time.monotonic() + TAKEN_LOOK_S
        if not self._store.scene(self._in_hand.scene_id).is_to_do(self._in_hand.job):
            raise TakenError

    def end(self, name: str, ending: Ending, reason: str) -> bool:
        """Keep a failure; StoreError if the store refuses it, as the job would be tried for ever."""
        self._in_hand = None
        if ending != "failed":
            return False
        with store_errors("keep why a job failed", self._store.storage.where):
            keep_failure(self._store, name, reason, worker=self._settings.name)
            return count_failures(self._store)[name] >= TRIES

    def has_more(self, *, may_leave: bool) -> bool:  # noqa: ARG002
        """Nothing: what others have in hand is missing until it is committed."""
        return False

    def set_aside(self) -> Mapping[str, str]:
        """Why jobs failed too often, by their names."""
        with store_errors("look for failures", self._store.storage.where):
            kept = read_kept_failures(self._store)
        return {name: failure.reason for name, failure in kept.items() if failure.set_aside}


def missing_jobs(
    store: Store, scene_ids: tuple[str, ...], *, followed: bool = False
) -> tuple[dict[str, list[int]], dict[str, StoreError]]:
    """The missing jobs of some scenes, or of all if none are named; and why scenes cannot be read. Both by scene id.

    `followed` is as in `SceneStore.missing_jobs`. Raises StoreError if the store, or a scene that is named, cannot be
    read.
    """
    if scene_ids:
        return {scene_id: store.scene(scene_id).missing_jobs(followed=followed) for scene_id in scene_ids}, {}
    return store.each(lambda scene: scene.missing_jobs(followed=followed))
