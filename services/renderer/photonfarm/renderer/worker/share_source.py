"""Jobs without Redis: a worker takes a share of them, and then what is left, with the store alone as truth.

What is missing is looked up in the store now and then, and each job once more before it is rendered. Nobody reserves a
job, so two workers may render the same one at the end. The one that learns of the other's commit gives its own up.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Mapping

from photonfarm import queue
from photonfarm.core.errors import StoreError, store_errors
from photonfarm.core.waiting import pause_after_look
from photonfarm.queue import TRIES, Activity, RenderArguments, Share, job_name
from photonfarm.renderer.worker.outcomes import missing_jobs
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.renderer.worker.source import Ending, JobSource, TakenError
from photonfarm.store import Store

LOOK_S = 30.0
"""The seconds after which the markers are looked at again; in between a job costs one question to the store.

Where a look takes long, it is done more rarely, as `pause_after_look` says.
"""

TAKEN_LOOK_S = 2.0
"""The seconds between two looks whether another worker has committed the job in hand."""

log = logging.getLogger(__name__)


class ShareSource(JobSource):
    """Takes the jobs of a share, and then others."""

    def __init__(self, settings: WorkerSettings, store: Store, share: Share) -> None:
        """Look at nothing yet."""
        self._settings, self._store, self._share = settings, store, share
        self._waiting: deque[RenderArguments] = deque()  # in the order in which they are taken
        self._look_due = self._taken_look_due = 0.0
        self.pause_s = settings.idle_s  # between looks that find nothing
        self._unreadable: Mapping[str, StoreError] = {}
        self._not_kept: dict[str, str] = {}  # reasons of failures that the store refused to keep, by the jobs' names
        self._in_hand: RenderArguments | None = None

    def take(self, paused: str | None, left: Mapping[str, str]) -> RenderArguments | None:
        """The next job that is still missing, if there is one."""
        looked = bool(paused)
        while not looked:  # what was left at the last look may have been rendered by others
            if looked := not self._waiting or time.monotonic() >= self._look_due:
                self._look()
            while self._waiting:
                job = self._waiting.popleft()
                if job.scene_id not in left and self._store.scene(job.scene_id).is_to_do(job.job):
                    self._in_hand, self._taken_look_due = job, time.monotonic() + TAKEN_LOOK_S
                    return job
        return None

    def _look(self) -> None:
        """List what is missing, without what has failed too often; what has failed comes last."""
        self._store.check()
        began = time.monotonic()
        missing, unreadable = missing_jobs(self._store, self._scenes(), followed=True)
        self.pause_s = pause_after_look(time.monotonic() - began, self._settings.idle_s)
        for scene_id in unreadable.keys() - self._unreadable.keys():
            log.warning("scene %s is passed over, and the others go on: %s", scene_id, unreadable[scene_id])
        self._unreadable = unreadable
        with store_errors("look for failures", self._store.storage.where):
            times = queue.count_failures(self._store) | dict.fromkeys(self._not_kept, TRIES)
        found = [
            (times.get(job_name(scene_id, job), 0), not self._share.owns(job), RenderArguments(scene_id, job))
            for scene_id, jobs in missing.items()
            for job in self._share.order(jobs)
        ]
        found.sort(key=lambda each: each[:2])
        self._waiting = deque(job for failed, _, job in found if failed < TRIES)
        self._look_due = time.monotonic() + max(LOOK_S, self.pause_s)

    def _scenes(self) -> tuple[str, ...]:
        """The scenes to render, of those that are named; a worker that waits for more lets them come later."""
        named = self._settings.scenes
        return named if self._settings.until_complete else tuple(filter(self._store.has_scene, named))

    def tell_doing(self, doing: Activity) -> None:  # noqa: ARG002 - nobody listens
        """Give the job in hand up if another worker has committed it."""
        if self._in_hand is None or time.monotonic() < self._taken_look_due:
            return
        self._taken_look_due = time.monotonic() + TAKEN_LOOK_S
        if not self._store.scene(self._in_hand.scene_id).is_to_do(self._in_hand.job):
            raise TakenError

    def end(self, name: str, ending: Ending, reason: str) -> bool:
        """Keep a failure; one that the store does not keep counts as the last, as the job would be tried for ever."""
        self._in_hand = None
        if ending != "failed":
            return False
        try:
            queue.keep_failure(self._store, name, reason, worker=self._settings.name)
            return queue.count_failures(self._store)[name] >= TRIES
        except OSError:
            self._not_kept[name] = reason
            return True

    def has_more(self, *, may_leave: bool) -> bool:  # noqa: ARG002
        """Nothing: what others have in hand is missing until it is committed."""
        return False

    def set_aside(self) -> Mapping[str, str]:
        """Why jobs failed too often."""
        with store_errors("look for failures", self._store.storage.where):
            kept = queue.read_kept_failures(self._store)
        return {name: failure.reason for name, failure in kept.items() if failure.set_aside} | self._not_kept
