"""The worker's child: renders one job after the other in a process that keeps its scenes loaded."""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping

import redis

from photonfarm import queue
from photonfarm.core.errors import IncompleteError, PhotonfarmError, SceneNotHereError, StoreError
from photonfarm.core.processes import Stop
from photonfarm.queue import Activity, RenderArguments, job_name
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.outcomes import Outcomes, WorkerLog, send_line
from photonfarm.renderer.worker.settings import GRACE_S, JOB_IN_HAND, LOG_FORMAT, RECYCLED, REFUSED, WorkerSettings
from photonfarm.renderer.worker.source import Ending, JobSource, QueueSource, ShareSource, TakenError, missing_jobs
from photonfarm.store import Store
from photonfarm.store.model.lease import read_leases

STDERR = 2

log = logging.getLogger(__name__)


def child(load: jobs.SceneLoader = jobs.load_scene) -> int:
    """The child's main function: settings from stdin, work, and the exit code; its last words go to stdout."""
    pipe = os.dup(1)
    os.dup2(2, 1)  # all other output, by Mitsuba say, goes to stderr
    settings = WorkerSettings.model_validate_json(sys.stdin.buffer.readline())
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format=LOG_FORMAT)
    threading.Thread(target=_end_with_supervisor, daemon=True).start()
    try:
        worker = RenderWorker(settings, Store(settings.store), load, pipe)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: worker.stop())
        return worker.run()
    except redis.RedisError as error:
        ending: PhotonfarmError = queue.queue_error(error)
    except PhotonfarmError as error:
        ending = error
    send_line(pipe, str(ending))
    return REFUSED if isinstance(ending, queue.RefusedError) else ending.exit_code


def _end_with_supervisor() -> None:
    """Stop once the supervisor is gone: after the job in hand, or in the middle of it after GRACE_S."""
    while os.read(0, 1):  # not through sys.stdin, whose lock would be held at the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


class RenderWorker:
    """Renders jobs, from the queue or of a share, until it is stopped, worn out or done."""

    def __init__(
        self, settings: WorkerSettings, store: Store, load: jobs.SceneLoader = jobs.load_scene, pipe: int | None = None
    ) -> None:
        """Prepare; `pipe` is a file descriptor that the supervisor reads. Raises QueueError if there is no Redis."""
        self._settings, self._store, self._pipe = settings, store, pipe
        self._stop = Stop()
        self._source: JobSource = (
            QueueSource(settings, store, self._stop)
            if settings.share is None
            else ShareSource(settings, store, settings.share)
        )
        self._renderer = jobs.ShardRenderer(store, worker=settings.name, load=load, on_progress=self._on_progress)
        self._outcomes = Outcomes(settings, store, pipe)
        self._talk = WorkerLog(settings)
        self._in_hand: str | None = None

    def run(self) -> int:
        """Work until stopped, complete or due for a successor; returns the exit code, 0 only if all is complete."""
        with self._source.open():
            while not self._stop.is_set():
                code = self.step()
                if code is not None:
                    return code
        return RECYCLED  # asked to stop: for a supervisor that is not to stop itself

    def stop(self) -> None:
        """End `run` after the job in hand."""
        self._stop.set()

    def step(self) -> int | None:
        """Render a job, or wait for one; an exit code ends the worker."""
        paused, left = self._outcomes.disk.reason(), self._skipped_scenes()
        self._talk.log_pause(paused)
        job = self._source.take(paused, left)
        if job is not None:
            self._render(job)
            return self._outcomes.after_job()
        if not self._stop.is_set() and self._is_complete(paused):
            return 0
        self._stop.wait(self._settings.idle_s if paused else self._source.pause_s)
        return None

    def _skipped_scenes(self) -> Mapping[str, str]:
        """Why this worker now takes no jobs of some scenes, by their ids."""
        waiting = {**self._source.ahead(), **read_leases(self._store.storage)}
        self._talk.log_waiting(waiting)
        return {**waiting, **self._outcomes.skipped_scenes()}

    def _is_complete(self, paused: str | None) -> bool:
        """Whether nothing is left to do or to wait for, after nothing was taken.

        Raises StoreError if the store is gone: an empty folder in its place would seem to miss nothing.
        """
        self._store.check()
        not_here = self._outcomes.not_here
        if self._source.has_more(may_leave=bool(not_here)) or paused:
            return False
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        missing, unreadable = missing_jobs(self._store, self._settings.scenes)
        return is_complete(missing, unreadable, self._source.set_aside(), not_here)

    def _render(self, job: RenderArguments) -> None:
        """Render a job under a deadline, and tell what it came to."""
        name, began = job_name(*job), time.monotonic()
        self._in_hand, rendered = name, False
        ending: Ending = "done"
        reason = ""
        with deadline(self._settings, self._pipe, name), self._talk.time_job(name):
            try:
                rendered = self._renderer.render(*job)
                if not rendered:
                    self._store.check()  # its scene may be gone with the whole store
            except TakenError:
                self._talk.log_given_up(name)
            except Exception as error:
                ending, reason = self._outcomes.judge_failure(name, error), f"{type(error).__name__}: {error}"
        self._in_hand = None
        self._outcomes.count(name, time.monotonic() - began, done=rendered, failed=ending != "done")
        if self._source.end(name, ending, reason):
            log.warning(
                "job %s has failed %d times and is set aside; photonfarm submit --retry queues it again, and this "
                "repeats it: %s",
                name,
                queue.TRIES,
                queue.repeating_command(self._settings.store, name),
            )

    def _on_progress(self, phase: str, done: int, total: int) -> None:
        self._source.tell_doing(Activity(phase, done, total, self._in_hand))


@contextlib.contextmanager
def deadline(settings: WorkerSettings, pipe: int | None, name: str) -> Iterator[None]:
    """Tell the supervisor of a job that the block renders; past the deadline the process ends, and prints where."""
    if pipe is not None:
        send_line(pipe, f"{JOB_IN_HAND}{name}")
    # its watchdog is a thread without Python's lock, so that it also ends native code that never returns
    faulthandler.dump_traceback_later(settings.deadline_s, exit=True, file=STDERR if pipe is None else pipe)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def is_complete(
    missing: Mapping[str, list[int]],
    unreadable: Mapping[str, StoreError],
    failed: Mapping[str, str],
    not_here: Mapping[str, SceneNotHereError],
) -> bool:
    """Whether a worker that is to stop when nothing is missing may stop; `failed` are reasons by the jobs' names.

    Raises the error for which it should rather end, as nothing is left that it could do or wait for.
    """
    scene_of = {queue.job_name(scene_id, job): scene_id for scene_id, jobs in missing.items() for job in jobs}
    not_failed = scene_of.keys() - failed.keys()
    if not_failed and all(scene_of[name] in not_here for name in not_failed):
        raise not_here[scene_of[min(not_failed)]]
    if unreadable and not not_failed:  # and nothing else is left: the other scenes' jobs were taken before
        raise unreadable[min(unreadable)]
    if scene_of and not not_failed:
        first = min(scene_of)
        failures = "1 job has" if len(scene_of) == 1 else f"{len(scene_of)} jobs have"
        raise IncompleteError(
            f"{failures} failed; {first}: {failed[first]}. `photonfarm status` has the causes, and commands that "
            "repeat them"
        )
    return not scene_of


if __name__ == "__main__":
    sys.exit(child())
