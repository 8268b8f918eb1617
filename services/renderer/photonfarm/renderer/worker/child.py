"""The worker's child: renders one job after the other in a process that keeps its scenes loaded.

It reports each job to the supervisor, which outlives it, however it ends. The log in normal operation is a line after
the first job and then one a minute, and why the worker takes no jobs.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import redis

from photonfarm.core.errors import (
    BackendError,
    CorruptError,
    IncompleteError,
    PhotonfarmError,
    QueueError,
    SceneNotHereError,
    StoreError,
)
from photonfarm.core.formatting import format_count
from photonfarm.core.processes import Stop
from photonfarm.queue.connection import RefusedError, queue_error
from photonfarm.queue.failures import repeating_command
from photonfarm.queue.job import TRIES, RenderArguments, job_name
from photonfarm.queue.workers import Activity
from photonfarm.renderer.jobs import render as jobs
from photonfarm.renderer.worker.backpressure import DiskReserve, is_full
from photonfarm.renderer.worker.settings import (
    GRACE_S,
    JOB_ENDED,
    JOB_IN_HAND,
    LOG_FORMAT,
    RECYCLED,
    REFUSED,
    WorkerSettings,
)
from photonfarm.renderer.worker.source import Ending, QueueSource, ShareSource, TakenError, missing_jobs
from photonfarm.store import Store
from photonfarm.store.model.lease import LeasedError, read_leases

STDERR = 2

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
        worker = RenderWorker(settings, Store(settings.store), load, pipe)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: worker.stop())
        return worker.run()
    except redis.RedisError as error:
        ending: PhotonfarmError = queue_error(error)
    except PhotonfarmError as error:
        ending = error
    _send_line(pipe, str(ending))
    return REFUSED if isinstance(ending, RefusedError) else ending.exit_code


def _end_with_supervisor() -> None:
    """Stop once the supervisor is gone: after the job in hand, or in the middle of it after GRACE_S."""
    while os.read(0, 1):  # not through sys.stdin, whose lock would be held at the interpreter's end
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


def _send_line(pipe: int | None, message: str) -> None:
    """Send a line to the supervisor, if there is one still."""
    if pipe is not None:
        with contextlib.suppress(BrokenPipeError):
            os.write(pipe, f"{' '.join(message.split())}\n".encode())


class RenderWorker:
    """Renders jobs, from the queue or of a share, until it is stopped, worn out or done."""

    def __init__(
        self, settings: WorkerSettings, store: Store, load: jobs.SceneLoader = jobs.load_scene, pipe: int | None = None
    ) -> None:
        """Prepare; `pipe` is a file descriptor that the supervisor reads. Raises QueueError if there is no Redis."""
        log.setLevel(logging.WARNING if settings.quiet else logging.INFO)
        self._settings, self._store, self._pipe = settings, store, pipe
        self._stop = Stop()
        self._source: QueueSource | ShareSource = (
            QueueSource(settings, store, self._stop)
            if settings.share is None
            else ShareSource(settings, store, settings.share)
        )
        self._renderer = jobs.ShardRenderer(store, worker=settings.name, load=load, on_progress=self._on_progress)
        self._disk = DiskReserve(store, settings.reserve_bytes)
        self._not_here: dict[str, tuple[SceneNotHereError, float]] = {}  # by scene id; until when it is left to others
        self._fatal: PhotonfarmError | None = None  # what the next job would meet as well
        self._tainted = False  # an unexpected error happened, perhaps in the middle of an edit
        self._in_hand: str | None = None
        self._jobs, self._jobs_s, self._logged_s = 0, 0.0, -settings.report_s
        self._pauses: set[str] = set()  # that are logged

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
        """Render a job, or wait for one; an exit code ends the worker. Raises what the next job would meet as well."""
        now = time.monotonic()
        self._not_here = {scene_id: entry for scene_id, entry in self._not_here.items() if now < entry[1]}
        paused = self._disk.reason()
        left = {**self._source.scenes_ahead(), **read_leases(self._store.storage)}
        left |= {scene_id: str(error) for scene_id, (error, _) in self._not_here.items()}
        self._log_pauses(paused, left)
        job = self._source.take(paused, left)
        if job is not None:
            self._render(job)
            if self._fatal:
                raise self._fatal
            worn = self._jobs >= self._settings.max_jobs or _resident_bytes() > self._settings.max_rss_bytes
            return RECYCLED if worn or self._tainted else None
        if not self._stop.is_set() and self._is_complete(paused):
            return 0
        self._stop.wait(self._settings.idle_s if paused else self._source.pause_s)
        return None

    def _log_pauses(self, paused: str | None, left: dict[str, str]) -> None:
        """Log once why jobs, or those of some scenes, are not taken, and once that they are taken again."""
        reasons = {f" of scene {scene_id}": reason for scene_id, reason in left.items()}
        if paused:
            reasons[""] = paused
        for whose in reasons.keys() - self._pauses:
            log.warning("worker %s: takes no jobs%s: %s", self._settings.name, whose, reasons[whose])
        for whose in self._pauses - reasons.keys():
            log.warning("worker %s: takes jobs%s again", self._settings.name, whose)
        self._pauses = set(reasons)

    def _is_complete(self, paused: str | None) -> bool:
        """Whether nothing is left to do or to wait for, after nothing was taken.

        Raises the error for which the worker should rather end, as nothing is left that it could do; and StoreError if
        the store is gone: an empty folder in its place would seem to miss nothing.
        """
        self._store.check()
        if self._source.has_more(may_leave=bool(self._not_here)) or paused:
            return False
        self._store.sweep()
        if not self._settings.until_complete:
            return False
        missing, unreadable = missing_jobs(self._store, self._settings.scenes)
        failed = self._source.set_aside()
        scene_of = {job_name(scene_id, job): scene_id for scene_id, jobs in missing.items() for job in jobs}
        if not_failed := scene_of.keys() - failed.keys():
            if all(scene_of[name] in self._not_here for name in not_failed):
                raise self._not_here[scene_of[min(not_failed)]][0]
            return False
        if unreadable:
            raise unreadable[min(unreadable)]
        if scene_of:
            first = min(scene_of)
            count = f"{format_count(len(scene_of), 'job')} {'has' if len(scene_of) == 1 else 'have'}"
            raise IncompleteError(
                f"{count} failed; {first}: {failed[first]}. `photonfarm status` has the causes, and commands that "
                "repeat them"
            )
        return True

    def _render(self, job: RenderArguments) -> None:
        """Render a job under a deadline, and tell what it came to."""
        name, began = job_name(*job), time.monotonic()
        self._in_hand, rendered = name, False
        ending: Ending = "done"
        reason = ""
        with self._deadline(name):
            try:
                rendered = self._renderer.render(*job)
                if not rendered:
                    self._store.check()  # its scene may be gone with the whole store
            except TakenError:
                log.info("worker %s: gives up %s, which another worker has committed", self._settings.name, name)
            except Exception as error:
                ending, reason = self._judge_failure(job, error), f"{type(error).__name__}: {error}"
        self._in_hand = None
        self._log_job(name, time.monotonic() - began)
        _send_line(self._pipe, f"{JOB_ENDED}{'left' if ending == 'done' and not rendered else ending}")
        if self._source.end(name, ending, reason):
            log.warning(
                "job %s has failed %d times and is set aside; photonfarm submit --retry queues it again, and this "
                "repeats it: %s",
                name,
                TRIES,
                repeating_command(self._settings.store, name),
            )

    @contextlib.contextmanager
    def _deadline(self, name: str) -> Iterator[None]:
        """Report a job that the block renders; past the deadline the process ends, and prints where."""
        _send_line(self._pipe, f"{JOB_IN_HAND}{name}")
        # its watchdog is a thread without Python's lock, so that it also ends native code that never returns
        file = STDERR if self._pipe is None else self._pipe
        faulthandler.dump_traceback_later(self._settings.deadline_s, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()

    def _log_job(self, name: str, seconds: float) -> None:
        """Count a job, and log how many there were, now and then."""
        self._jobs, self._jobs_s, now = self._jobs + 1, self._jobs_s + seconds, time.monotonic()
        if now - self._logged_s >= self._settings.report_s:
            self._logged_s, each_s = now, self._jobs_s / self._jobs
            said = (
                f"{format_count(self._jobs, 'job')} in {self._jobs_s:.0f} s, {each_s:.2f} s each; the last was {name}"
            )
            log.info("worker %s: %s", self._settings.name, said)

    def _judge_failure(self, job: RenderArguments, error: Exception) -> Ending:
        """Decide the consequences of a failed job, for this worker, and return those for the job."""
        name = job_name(*job)
        with contextlib.suppress(PhotonfarmError, OSError):
            if self._store.scene(job.scene_id).is_committed(job.job):
                log.warning("job %s is committed, and nothing lost: %s", name, error)
                return "done"
        if isinstance(error, LeasedError):
            log.info("job %s is left for now: %s", name, error)
            return "again"
        log.warning("job %s failed: %s", name, error, exc_info=None if isinstance(error, PhotonfarmError) else error)
        if is_full(error):
            self._disk.note_refusal()
            return "again"
        if isinstance(error, SceneNotHereError) and self._settings.scene_id is None:
            self._not_here[job.scene_id] = error, time.monotonic() + NOT_HERE_S
            return "again"
        if (fatal := self._fatal_of(error)) is not None:
            self._fatal = fatal
            return "again"
        if isinstance(error, QueueError):  # a queued job that the store does not have
            return "done"
        self._tainted = not isinstance(error, PhotonfarmError)
        return "failed"

    def _fatal_of(self, error: Exception) -> PhotonfarmError | None:
        """The error that the next job would meet as well; if the store is gone, whatever error the job had."""
        try:
            self._store.check()
        except StoreError as gone:
            return gone
        return error if isinstance(error, StoreError | BackendError) and not isinstance(error, CorruptError) else None

    def _on_progress(self, phase: str, done: int, total: int) -> None:
        self._source.tell_doing(Activity(phase, done, total, self._in_hand))


def _resident_bytes() -> int:
    """The memory of this process now; its peak if the system does not state it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


if __name__ == "__main__":
    sys.exit(child())
