"""The worker's child: a worker on the queue that keeps its scenes loaded.

It adds what RQ lacks: a deadline that also ends native code, recycling, and filling the queue when idle.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import redis
from redis import Redis

from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.backpressure import DiskReserve, TrainerPace, is_full
from photonfarm.renderer.worker.heartbeat import HeartbeatThread
from photonfarm.renderer.worker.log import JobCounts, WorkerLog
from photonfarm.renderer.worker.settings import GRACE_S, LOG_FORMAT, RECYCLED, WorkerSettings
from photonfarm.shared import queue
from photonfarm.shared.core.errors import (
    BackendError,
    CorruptError,
    IncompleteError,
    PhotonfarmError,
    QueueError,
    SceneNotHereError,
    StoreError,
)
from photonfarm.shared.queue import QueueWorker, RenderArguments, RenderJob
from photonfarm.shared.store import SceneStore, Store

STARTS_ALLOWED = 5
"""The starts of one job without an end after which it counts as failed: it kills its workers."""

POLL_S = 0.2
"""The seconds between looks at an empty queue."""

NOT_HERE_S = 300.0
"""How long a scene whose files are missing here is left to other workers before its files are looked for again."""

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
        worker = RenderWorker(settings, store, queue.connect(settings.redis_url), pipe)
        jobs.serve(jobs.ShardRenderer(store, worker=settings.name, load=load, on_progress=worker.doing))
        return worker.run()
    except PhotonfarmError as error:
        _send_line(pipe, str(error))
        return error.exit_code
    except redis.RedisError as error:
        _send_line(pipe, f"lost Redis: {error}")
        return QueueError.exit_code


def _send_line(pipe: int, message: str) -> None:
    """Send a line to the supervisor, if it is still there."""
    with contextlib.suppress(BrokenPipeError):
        os.write(pipe, f"{' '.join(message.split())}\n".encode())  # a line, which the supervisor repeats


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
        self._fatal: PhotonfarmError | None = None
        self._tainted = False  # an unexpected error happened, perhaps in the middle of an edit
        self._failed = False  # the job in hand
        self._not_here: dict[str, SceneNotHereError] = {}  # by scene id, the scenes that this machine leaves to others…
        self._look_again: dict[str, float] = {}  # …and until when
        self._heart = HeartbeatThread(settings, store, pipe)
        self.doing = self._heart.doing
        self._disk = DiskReserve(store, settings.reserve_bytes)
        self._pace = (
            None
            if settings.ahead is None
            else TrainerPace(store, connection, settings.ahead, scene_id=settings.scene_id)
        )
        self._talk = WorkerLog(settings)
        self._pipe = pipe
        self._counts = JobCounts()
        self._done = 0

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
        held_back = self._disk.reason()
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
        for scene_id in [scene_id for scene_id, until in self._look_again.items() if time.monotonic() >= until]:
            del self._not_here[scene_id], self._look_again[scene_id]
        return {**ahead, **{scene_id: str(error) for scene_id, error in self._not_here.items()}}

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
        if found == "queued" or (found == "waits" and not self._not_here):  # what is left may be nothing for this one
            return False
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        missing, unreadable = self._missing()
        failed = queue.queue_status(self.connection).failed
        not_failed = missing.keys() - failed.keys()
        if not_failed and all(missing[name] in self._not_here for name in not_failed):
            raise self._not_here[missing[min(not_failed)]]
        if unreadable and not not_failed:  # and nothing else is left: the other scenes' jobs were taken before
            raise unreadable[min(unreadable)]
        if missing and not not_failed:
            first = min(missing)
            raise IncompleteError(
                f"{len(missing)} jobs have failed; {first}: {failed[first].reason}. `photonfarm status` has the "
                "causes, and commands that repeat them"
            )
        return not missing

    def _missing(self) -> tuple[dict[str, str], dict[str, StoreError]]:
        """The scene ids of the missing jobs, by their names; and why some scenes cannot be read, by their ids."""
        only = self._settings.scene_id
        unreadable: dict[str, StoreError] = {}
        if only is None:
            found, unreadable = self._store.each(SceneStore.missing_jobs)
        else:
            found = {only: self._store.scene(only).missing_jobs()}
        return {queue.job_name(scene, job): scene for scene, jobs in found.items() for job in jobs}, unreadable

    # ------------------------------------------------------------------------------------------------------------- jobs

    def on_job(self, job: RenderJob, run: Callable[[], None]) -> None:
        """Run one job under a heartbeat and a deadline."""
        self._failed = False
        began = time.monotonic()
        with self._heart.working(job.id), self._talk.timing(job.id):
            self._count_start(job)
            run()
            self._settle(job.id)
        self._count(job.id, time.monotonic() - began)

    def on_done(self) -> int | None:
        """Raise the error that the next job would meet as well; RECYCLED if a successor should go on."""
        self._done += 1
        if self._fatal:
            raise self._fatal
        worn = self._done >= self._settings.max_jobs or _resident_bytes() > self._settings.max_rss_bytes
        return RECYCLED if worn or self._tainted else None

    def _count(self, name: str, seconds: float) -> None:
        """Report the jobs so far to the supervisor, which outlives this process, however it ends."""
        done = not self._failed
        self._counts += JobCounts(done, not done, self._samples(name) if done else 0, seconds)
        if self._pipe is not None:
            _send_line(self._pipe, self._counts.line)

    def _samples(self, name: str) -> int:
        """The number of samples of a job; 0 if its scene cannot be read any more."""
        with contextlib.suppress(PhotonfarmError, IndexError):
            arguments = RenderArguments.of(name)
            return len(self._store.scene(arguments.scene_id).job_rows(arguments.job).samples)
        return 0

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
        if self._failed:
            queue.forget_starts_of(self.connection, name)
        else:
            queue.forget_failures_of(self.connection, name)

    def on_failure(self, name: str, error: BaseException) -> None:
        """Decide the consequences of a failed job: for the job, for this worker, or none."""
        if self._is_committed(name):
            log.warning("job %s is committed, and nothing lost; only Redis does not know it: %s", name, error)
            return
        self._failed = True
        what = "lost Redis" if isinstance(error, redis.RedisError) else "failed"
        known = isinstance(error, PhotonfarmError | redis.RedisError)
        log.warning("job %s %s: %s", name, what, error, exc_info=None if known else error)
        if is_full(error):
            self._disk.refused()
        elif isinstance(error, SceneNotHereError) and self._settings.scene_id is None:
            scene_id = name.rpartition("-")[0]
            self._not_here[scene_id] = error
            self._look_again[scene_id] = time.monotonic() + NOT_HERE_S
            log.warning("this worker leaves scene %s to others, and goes on with what else there is", scene_id)
        elif (fatal := self._fatal_of(error)) is not None:
            self._fatal = fatal
            with contextlib.suppress(redis.RedisError):
                queue.put_back(self._queue, name)
        elif isinstance(error, Exception) and not isinstance(error, QueueError | redis.RedisError):
            self._tainted = not isinstance(error, PhotonfarmError)
            self._record(name, f"{type(error).__name__}: {error}")

    def _fatal_of(self, error: BaseException) -> PhotonfarmError | None:
        """The error that the next job would meet as well; if the store is gone, whatever error the job had."""
        if isinstance(error, redis.RedisError):
            return None
        try:
            self._store.check()
        except StoreError as gone:
            return gone
        return error if isinstance(error, StoreError | BackendError) and not isinstance(error, CorruptError) else None

    def _is_committed(self, name: str) -> bool:
        with contextlib.suppress(PhotonfarmError, OSError):
            arguments = RenderArguments.of(name)
            return self._store.scene(arguments.scene_id).is_done(arguments.job)
        return False

    def _record(self, name: str, reason: str) -> None:
        """Record a failure: in the store for people, and in Redis, so that the job is left alone for a while."""
        with contextlib.suppress(OSError):
            queue.keep_failure(self._store, name, reason, worker=self._settings.name, at_s=time.time())
        with contextlib.suppress(redis.RedisError):
            self._set_aside_at_last(name, reason)

    def _set_aside_at_last(self, name: str, reason: str) -> None:
        failure = queue.record_failure(self.connection, name, reason)
        if failure.set_aside:
            log.warning(
                "job %s has failed %d times and is set aside; photonfarm submit --retry queues it again, and this "
                "repeats it: %s",
                name,
                failure.times,
                queue.repeating_command(self._settings.store, name),
            )


def _resident_bytes() -> int:
    """The memory of this process now; its peak if the system does not state it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


if __name__ == "__main__":
    sys.exit(child())
