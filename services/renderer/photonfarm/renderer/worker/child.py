"""The worker's child: a worker that keeps its scenes loaded, on the queue or, by `share_worker`, without it.

On the queue it adds what RQ lacks: a deadline that also ends native code, recycling, and filling the queue when idle.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import redis
from redis import Redis

from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.backpressure import TrainerPace
from photonfarm.renderer.worker.heartbeat import HeartbeatThread
from photonfarm.renderer.worker.log import WorkerLog
from photonfarm.renderer.worker.outcomes import Outcomes, is_complete, missing_jobs, send_line
from photonfarm.renderer.worker.settings import GRACE_S, LOG_FORMAT, RECYCLED, WorkerSettings
from photonfarm.renderer.worker.share_worker import ShareWorker
from photonfarm.shared import queue
from photonfarm.shared.core.errors import PhotonfarmError, QueueError
from photonfarm.shared.queue import QueueWorker, RenderJob
from photonfarm.shared.store import Store

STARTS_ALLOWED = 5
"""The starts of one job without an end after which it counts as failed: it kills its workers."""

POLL_S = 0.2
"""The seconds between looks at an empty queue."""

log = logging.getLogger(__name__)


def child(load: jobs.SceneLoader = jobs.load_scene) -> int:
    """The child's main function: settings from stdin, work, and the exit code; its last words go to stdout."""
    pipe = os.dup(1)
    os.dup2(2, 1)  # all other output, by Mitsuba say, goes to stderr
    settings = WorkerSettings.model_validate_json(sys.stdin.buffer.readline())
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format=LOG_FORMAT)
    threading.Thread(target=_end_with_supervisor, daemon=True).start()
    try:
        store = Store(settings.store)
        if settings.share is not None:
            return ShareWorker(settings, store, settings.share, load, pipe).run()
        worker = RenderWorker(settings, store, queue.connect(settings.queue_url), pipe)
        jobs.serve(jobs.ShardRenderer(store, worker=settings.name, load=load, on_progress=worker.doing))
        return worker.run()
    except PhotonfarmError as error:
        send_line(pipe, str(error))
        return error.exit_code
    except redis.RedisError as error:
        send_line(pipe, f"lost Redis: {error}")
        return QueueError.exit_code


def _end_with_supervisor() -> None:
    """Stop once the supervisor is gone: after the job in hand, or in the middle of it after GRACE_S."""
    while os.read(0, 1):  # not through sys.stdin, whose lock would be held at the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


class RenderWorker(QueueWorker):
    """A worker that renders, with a heartbeat and a deadline, and fills the queue when idle."""

    def __init__(self, settings: WorkerSettings, store: Store, connection: Redis, pipe: int | None = None) -> None:
        """Prepare without registering; `pipe` is a file descriptor that the supervisor reads, if there is one."""
        name = f"{settings.name}-{os.getpid()}-{time.time_ns():x}"
        super().__init__(connection, name, job_ttl_s=int(settings.deadline_s) + 60)
        self._settings = settings
        self._store = store
        self._heart = HeartbeatThread(settings, store, pipe)
        self.doing = self._heart.doing
        self._outcomes = Outcomes(
            settings, store, pipe, record=self._record, put_back=lambda name: queue.put_back(self._queue, name)
        )
        self._pace = (
            None
            if settings.ahead is None
            else TrainerPace(store, connection, settings.ahead, scene_id=settings.scene_id)
        )
        self._talk = WorkerLog(settings)

    def run(self) -> int:
        """Work until stopped, complete or due for a successor; returns the exit code, 0 only if all is complete."""
        self._heart.start()
        code = self.work_on()
        return RECYCLED if code is None else code  # asked to stop: for a supervisor that is not to stop itself

    def on_end(self) -> None:
        """Remove the heartbeat."""
        self._heart.end()

    # ---------------------------------------------------------------------------------------------------- taking a job

    def next_job(self) -> RenderJob | None:
        """Take the next job; None if there was none for a while, or none should be taken."""
        queue.serve(self.connection, self._store)
        held_back = self._outcomes.disk.reason()
        self._talk.pausing(held_back)
        self._heart.paused = held_back
        self._heart.left = self._left()
        until = time.monotonic() + self._settings.idle_s
        while True:
            job, strangers = (None, 0) if held_back else self._next()
            if strangers:
                log.warning("%d entries of the queue were not names of jobs, and were thrown away", strangers)
            if job is not None or time.monotonic() >= until:
                return job
            time.sleep(self._settings.idle_s if self._heart.left else POLL_S)  # Redis checks each job that is skipped

    def _next(self) -> tuple[RenderJob | None, int]:
        return queue.take(self._queue, scene_id=self._settings.scene_id, leave=self._heart.left)

    def _left(self) -> dict[str, str]:
        """Why this worker now takes no jobs of some scenes, by their ids."""
        ahead = self._pace.ahead() if self._pace else {}
        self._talk.waiting(ahead)
        return {**ahead, **self._outcomes.left()}

    def on_idle(self) -> int | None:
        """Fill the queue; 0 if nothing is left to do."""
        return 0 if self._fill_or_finish() else None

    def _fill_or_finish(self) -> bool:
        """Fill the queue from the store, as there is no coordinator; True if there is nothing left to wait for.

        Raises StoreError if the store is gone: an empty folder in its place would seem to miss nothing.
        """
        self._store.check()
        only = self._settings.scene_id
        found = queue.look(self._store, self.connection, scene_id=only, every_s=self._settings.idle_s)
        if found == "queued" or (found == "waits" and not self._outcomes.not_here):  # what is left may not be for it
            return False
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        missing, unreadable = missing_jobs(self._store, () if only is None else (only,))
        failed = queue.queue_status(self.connection).failed
        reasons = {name: failure.reason for name, failure in failed.items()}
        return is_complete(missing, unreadable, reasons, self._outcomes.not_here)

    # ------------------------------------------------------------------------------------------------------------- jobs

    def on_job(self, job: RenderJob, run: Callable[[], None]) -> None:
        """Run one job under a heartbeat and a deadline."""
        self._outcomes.begin()
        began = time.monotonic()
        with self._heart.working(job.id), self._talk.timing(job.id):
            self._count_start(job)
            run()
            self._settle(job.id)
        self._outcomes.count(job.id, time.monotonic() - began)

    def on_done(self) -> int | None:
        """Raise the error that the next job would meet as well; RECYCLED if a successor should go on."""
        return self._outcomes.after_job()

    def _count_start(self, job: RenderJob) -> None:
        """Count a start, and refuse a job that has been started too often."""
        starts = queue.count_start(self.connection, job.id)
        if starts > STARTS_ALLOWED:
            job.refuse(self._given_up(job.id, starts - 1))

    def _given_up(self, name: str, starts: int) -> str:
        """Why a job is not started again."""
        overdue = min(queue.overdue(self.connection, name), starts)
        late = f"it took longer than --deadline {self._settings.deadline_s:g} s and was ended"
        if overdue == starts:
            return f"it was started {starts} times, and each time {late}"
        died = f"it was started {starts} times, and each time its worker died or lost Redis"
        return f"{died}, or {late} ({overdue} times)" if overdue else died

    def _settle(self, name: str) -> None:
        """Reset the counts of a job's starts, which has ended; its failures stay."""
        if self._outcomes.has_failed:
            queue.forget_starts_of(self.connection, name)
        else:
            queue.forget_failures_of(self.connection, name)

    def on_failure(self, name: str, error: BaseException) -> None:
        """Decide the consequences of a failed job: for the job, for this worker, or none."""
        self._outcomes.failed(name, error)

    def _record(self, name: str, reason: str) -> None:
        """Record a failure in Redis, so that the job is left alone for a while, or for good."""
        failure = queue.record_failure(self.connection, name, reason)
        if failure.set_aside:
            log.warning(
                "job %s has failed %d times and is set aside; photonfarm submit --retry queues it again, and this "
                "repeats it: %s",
                name,
                failure.times,
                queue.repeating_command(self._settings.store, name),
            )


if __name__ == "__main__":
    sys.exit(child())
