"""What the jobs of a child come to: counts for its supervisor, and the consequences of errors for job and worker.

The log in normal operation is a line after the first job and then one a minute, and why the worker pauses.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.errors import (
    BackendError,
    CorruptError,
    PhotonfarmError,
    QueueError,
    SceneNotHereError,
    StoreError,
)
from photonfarm.core.formatting import format_count
from photonfarm.queue import RenderArguments
from photonfarm.renderer.worker.backpressure import DiskReserve, is_full
from photonfarm.renderer.worker.settings import JOBS_SO_FAR, RECYCLED, WorkerSettings
from photonfarm.renderer.worker.source import Ending
from photonfarm.store import Store
from photonfarm.store.model.lease import LeasedError


@dataclass(frozen=True, slots=True)
class JobCounts:
    """Counts of jobs and samples."""

    jobs: int = 0  # done
    failed: int = 0
    samples: int = 0  # of those that are done
    seconds: float = 0.0  # of all

    def __add__(self, other: JobCounts) -> JobCounts:
        """The sum of both."""
        return JobCounts(
            self.jobs + other.jobs,
            self.failed + other.failed,
            self.samples + other.samples,
            self.seconds + other.seconds,
        )

    @property
    def line(self) -> str:
        """The counts as a child writes them to its supervisor."""
        return f"{JOBS_SO_FAR}{self.jobs} {self.failed} {self.samples} {self.seconds:.3f}"

    @classmethod
    def of(cls, line: str) -> JobCounts:
        """The counts in a line of a child."""
        jobs, failed, samples, seconds = line.removeprefix(JOBS_SO_FAR).split()
        return cls(int(jobs), int(failed), int(samples), float(seconds))

    def __str__(self) -> str:
        """The counts in words."""
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{format_count(self.jobs, 'job')} done{failed}, {self.samples} samples, {self.seconds:.0f} s"


class WorkerLog:
    """Counts jobs, and logs progress; with `quiet` only what holds the worker up."""

    def __init__(self, settings: WorkerSettings) -> None:
        """Start counting."""
        log.setLevel(logging.WARNING if settings.quiet else logging.INFO)
        self._name = settings.name
        self._every_s = settings.report_s
        self._jobs = 0
        self._seconds = 0.0
        self._logged_s = -settings.report_s
        self._pausing = False
        self._waiting: set[str] = set()

    @contextlib.contextmanager
    def time_job(self, name: str) -> Iterator[None]:
        """Time a job while the block runs."""
        began = time.monotonic()
        yield
        now = time.monotonic()
        self._jobs += 1
        self._seconds += now - began
        if now - self._logged_s >= self._every_s:
            self._logged_s = now
            log.info(
                "worker %s: %s in %.0f s, %.2f s each; the last was %s",
                self._name,
                format_count(self._jobs, "job"),
                self._seconds,
                self._seconds / self._jobs,
                name,
            )

    def log_given_up(self, name: str) -> None:
        """Log that a job in hand was given up, as another worker has committed it."""
        log.info("worker %s: gives up %s, which another worker has committed", self._name, name)

    def log_pause(self, reason: str | None) -> None:
        """Log once that no jobs are taken, and once that they are taken again."""
        if reason and not self._pausing:
            log.warning("worker %s: takes no jobs: %s", self._name, reason)
        elif self._pausing and not reason:
            log.warning("worker %s: takes jobs again", self._name)
        self._pausing = bool(reason)

    def log_waiting(self, ahead: Mapping[str, str]) -> None:
        """Log once for each scene why its jobs are skipped, and once that they are taken again."""
        for scene_id in ahead.keys() - self._waiting:
            log.warning("worker %s: takes no jobs of scene %s: %s", self._name, scene_id, ahead[scene_id])
        for scene_id in self._waiting - ahead.keys():
            log.warning("worker %s: takes jobs of scene %s again", self._name, scene_id)
        self._waiting = set(ahead)


NOT_HERE_S = 300.0
"""How long a scene whose files are missing here is left to other workers before its files are looked for again."""

log = logging.getLogger(__name__)


def send_line(pipe: int, message: str) -> None:
    """Send a line to the supervisor, if it is still there."""
    with contextlib.suppress(BrokenPipeError):
        os.write(pipe, f"{' '.join(message.split())}\n".encode())  # a line, which the supervisor repeats


class Outcomes:
    """What the jobs of a child come to."""

    def __init__(self, settings: WorkerSettings, store: Store, pipe: int | None) -> None:
        """Begin to count; `pipe` is a file descriptor that the supervisor reads, if there is one."""
        self.disk = DiskReserve(store, settings.reserve_bytes)
        self.not_here: dict[str, SceneNotHereError] = {}  # by scene id, the scenes that this machine leaves to others…
        self._look_again: dict[str, float] = {}  # …and until when
        self._settings, self._store, self._pipe = settings, store, pipe
        self._fatal: PhotonfarmError | None = None
        self._tainted = False  # an unexpected error happened, perhaps in the middle of an edit
        self._counts = JobCounts()
        self._jobs = 0

    def count(self, name: str, seconds: float, *, done: bool, failed: bool) -> None:
        """Report the jobs so far to the supervisor, which outlives this process, however it ends.

        The job in hand has ended; one neither done nor failed was left to another worker.
        """
        self._jobs += 1
        self._counts += JobCounts(done, failed, self._samples(name) if done else 0, seconds)
        if self._pipe is not None:
            send_line(self._pipe, self._counts.line)

    def after_job(self) -> int | None:
        """Raise the error that the next job would meet as well; RECYCLED if a successor should go on."""
        if self._fatal:
            raise self._fatal
        worn = self._jobs >= self._settings.max_jobs or _resident_bytes() > self._settings.max_rss_bytes
        return RECYCLED if worn or self._tainted else None

    def skipped_scenes(self) -> dict[str, str]:
        """Why this worker takes no jobs of some scenes, by their ids: their files are not here."""
        for scene_id in [scene_id for scene_id, until in self._look_again.items() if time.monotonic() >= until]:
            del self.not_here[scene_id], self._look_again[scene_id]
        return {scene_id: str(error) for scene_id, error in self.not_here.items()}

    def judge_failure(self, name: str, error: Exception) -> Ending:
        """Decide the consequences of a failed job, for this worker, and return those for the job."""
        if self._is_committed(name):
            log.warning("job %s is committed, and nothing lost: %s", name, error)
            return "done"
        if isinstance(error, LeasedError):
            log.info("job %s is left for now: %s", name, error)
            return "again"
        log.warning("job %s failed: %s", name, error, exc_info=None if isinstance(error, PhotonfarmError) else error)
        if is_full(error):
            self.disk.note_refusal()
            return "again"
        if isinstance(error, SceneNotHereError) and self._settings.scene_id is None:
            scene_id = name.rpartition("-")[0]
            self.not_here[scene_id] = error
            self._look_again[scene_id] = time.monotonic() + NOT_HERE_S
            log.warning("this worker leaves scene %s to others, and goes on with what else there is", scene_id)
            return "again"
        if (fatal := self._fatal_of(error)) is not None:
            self._fatal = fatal
            return "again"
        if isinstance(error, QueueError):  # the store has no such job
            return "done"
        self._tainted = not isinstance(error, PhotonfarmError)
        return "failed"

    def _samples(self, name: str) -> int:
        """The number of samples of a job; 0 if its scene cannot be read any more."""
        with contextlib.suppress(PhotonfarmError, IndexError):
            arguments = RenderArguments.of(name)
            return len(self._store.scene(arguments.scene_id).job_rows(arguments.job).samples)
        return 0

    def _fatal_of(self, error: Exception) -> PhotonfarmError | None:
        """The error that the next job would meet as well; if the store is gone, whatever error the job had."""
        try:
            self._store.check()
        except StoreError as gone:
            return gone
        return error if isinstance(error, StoreError | BackendError) and not isinstance(error, CorruptError) else None

    def _is_committed(self, name: str) -> bool:
        with contextlib.suppress(PhotonfarmError, OSError):
            arguments = RenderArguments.of(name)
            return self._store.scene(arguments.scene_id).is_committed(arguments.job)
        return False


def _resident_bytes() -> int:
    """The memory of this process now; its peak if the system does not state it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS
