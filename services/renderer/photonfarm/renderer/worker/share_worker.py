"""The worker's child without Redis: it takes a share of the jobs, and then what is left, with the store alone as truth.

What is missing is looked up in the store now and then, and each job once more before it is rendered. Nobody reserves a
job, so two workers may render the same one at the end. The one that learns of the other's commit gives its own up.
"""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Mapping

from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.heartbeat import in_hand
from photonfarm.renderer.worker.log import WorkerLog
from photonfarm.renderer.worker.outcomes import Outcomes, is_complete, missing_jobs
from photonfarm.renderer.worker.settings import RECYCLED, WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.core.errors import StoreError, store_errors
from photonfarm.shared.core.processes import Stop
from photonfarm.shared.core.waiting import pause_after_look
from photonfarm.shared.queue import Share, job_name
from photonfarm.shared.store import Store

LOOK_S = 30.0
"""The seconds after which the markers are looked at again; in between a job costs one question to the store.

Where a look takes long, it is done more rarely, as `pause_after_look` says.
"""

TAKEN_LOOK_S = 2.0
"""The seconds between two looks whether another worker has committed the job in hand."""

log = logging.getLogger(__name__)


class _TakenError(Exception):
    """Another worker has committed the job in hand."""


class ShareWorker:
    """Renders the jobs of a share, and then others."""

    def __init__(
        self, settings: WorkerSettings, store: Store, share: Share, load: jobs.SceneLoader, pipe: int | None = None
    ) -> None:
        """Prepare; `pipe` is a file descriptor that the supervisor reads, if there is one."""
        self._settings, self._store, self._share, self._pipe = settings, store, share, pipe
        self._scene_ids = (settings.scene_id,) if settings.scene_id else settings.scene_ids
        self._stop = Stop()
        self._talk = WorkerLog(settings)
        self._outcomes = Outcomes(settings, store, pipe, record=self._record, put_back=lambda _: None)
        self._renderer = jobs.ShardRenderer(store, worker=settings.name, load=load, on_progress=self._on_progress)
        self._waiting: deque[tuple[str, int]] = deque()  # scene ids and jobs, in the order in which they are taken
        self._look_due = self._taken_look_due = 0.0
        self._pause_s: float = settings.idle_s  # between looks that find nothing
        self._missing: Mapping[str, list[int]] = {}  # by scene id, at the last look
        self._unreadable: Mapping[str, StoreError] = {}
        self._left_alone: set[str] = set()  # names of jobs that have failed
        self._not_kept: dict[str, str] = {}  # reasons of failures that the store refused to keep, by the jobs' names
        self._in_hand: tuple[str, int] | None = None

    def run(self) -> int:
        """Work until stopped, complete or due for a successor; returns the exit code, 0 only if all is complete."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._stop.set())
        while not self._stop.is_set():
            code = self._step()
            if code is not None:
                return code
        return RECYCLED  # asked to stop: for a supervisor that is not to stop itself

    def _step(self) -> int | None:
        """Render a job, or wait for one; an exit code ends the worker."""
        held_back = self._outcomes.disk.reason()
        self._talk.pausing(held_back)
        job = None if held_back else self._next()
        if job is not None:
            self._render(*job)
            return self._outcomes.after_job()
        if not held_back and self._nothing_is_left():
            return 0
        self._stop.wait(self._pause_s)
        return None

    # ---------------------------------------------------------------------------------------------------- taking a job

    def _next(self) -> tuple[str, int] | None:
        """The next job that is still missing, if there is one."""
        looked = False
        while not looked:  # what was left at the last look may have been rendered by others
            if looked := not self._waiting or time.monotonic() >= self._look_due:
                self._look()
            while self._waiting:
                scene_id, job = self._waiting.popleft()
                if self._store.scene(scene_id).is_to_do(job):
                    return scene_id, job
        return None

    def _look(self) -> None:
        """List what is missing, without what has failed and what cannot be rendered here."""
        self._store.check()
        began, scenes = time.monotonic(), self._scenes()
        self._missing, unreadable = missing_jobs(self._store, scenes, followed=True)
        if self._settings.until_complete and not any(self._missing.values()):  # this worker may end: is it really so?
            self._missing, unreadable = missing_jobs(self._store, scenes)
        self._pause_s = pause_after_look(time.monotonic() - began, self._settings.idle_s)
        for scene_id, error in unreadable.items():
            if scene_id not in self._unreadable:
                log.warning("scene %s is passed over, and the others go on: %s", scene_id, error)
        self._unreadable = unreadable
        with store_errors("look for failures", self._store.storage.where):
            self._left_alone = queue.jobs_left_alone(self._store, time.time()) | self._not_kept.keys()
        left = self._outcomes.left()
        found = [
            (scene_id, job)
            for scene_id, missing in self._missing.items()
            if scene_id not in left
            for job in self._share.order([job for job in missing if job_name(scene_id, job) not in self._left_alone])
        ]
        self._waiting = deque(sorted(found, key=lambda scene_and_job: not self._share.owns(scene_and_job[1])))
        self._look_due = time.monotonic() + max(LOOK_S, self._pause_s)

    def _scenes(self) -> tuple[str, ...]:
        """The scenes to render, of those that are named; a worker that waits for more lets them come later."""
        if self._settings.until_complete or not self._scene_ids:
            return self._scene_ids
        return tuple(filter(self._store.has_scene, self._scene_ids))

    def _nothing_is_left(self) -> bool:
        """Whether this worker may end, after a look that found nothing to take; raises the error why it should."""
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        failed = {name: kept.reason for name, kept in self._kept().items()} | self._not_kept
        return is_complete(self._missing, self._unreadable, failed, self._outcomes.not_here)

    def _kept(self) -> Mapping[str, queue.Failure]:
        with store_errors("look for failures", self._store.storage.where):
            return queue.kept_failures(self._store, self._left_alone.__contains__)

    # ------------------------------------------------------------------------------------------------------- rendering

    def _render(self, scene_id: str, job: int) -> None:
        """Render a job under a deadline."""
        name, began = job_name(scene_id, job), time.monotonic()
        self._in_hand, self._taken_look_due = (scene_id, job), began + TAKEN_LOOK_S
        self._outcomes.begin()
        rendered = False
        with in_hand(self._settings, self._pipe, name), self._talk.timing(name):
            try:
                rendered = self._renderer.render(scene_id, job)
            except _TakenError:
                self._talk.given_up(name)
            except Exception as error:
                self._outcomes.failed(name, error)
        self._in_hand = None
        self._outcomes.count(name, time.monotonic() - began, done=rendered)

    def _on_progress(self, phase: str, done: int, total: int) -> None:  # noqa: ARG002 - see `jobs.OnProgress`
        """Give the job in hand up if another worker has committed it."""
        if self._in_hand is None or time.monotonic() < self._taken_look_due:
            return
        self._taken_look_due = time.monotonic() + TAKEN_LOOK_S
        scene_id, job = self._in_hand
        if not self._store.scene(scene_id).is_to_do(job):
            raise _TakenError

    def _record(self, name: str, reason: str) -> None:
        """Remember a failure that the store has not kept, as the job would be tried again for ever."""
        if name not in queue.jobs_left_alone(self._store, time.time()):
            self._not_kept[name] = reason
