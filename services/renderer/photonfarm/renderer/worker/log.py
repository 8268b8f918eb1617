"""The log of a worker in normal operation: a line after its first job and then one a minute, and why it pauses."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from photonfarm.renderer.worker.settings import JOBS_SO_FAR, WorkerSettings

log = logging.getLogger(__name__)


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
        return f"{counted(self.jobs)} done{failed}, {self.samples} samples, {self.seconds:.0f} s"


def counted(jobs: int) -> str:
    """A number of jobs, in words."""
    return f"{jobs} job{'s' * (jobs != 1)}"


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
    def timing(self, name: str) -> Iterator[None]:
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
                counted(self._jobs),
                self._seconds,
                self._seconds / self._jobs,
                name,
            )

    def given_up(self, name: str) -> None:
        """Log that a job in hand was given up, as another worker has committed it."""
        log.info("worker %s: gives up %s, which another worker has committed", self._name, name)

    def pausing(self, reason: str | None) -> None:
        """Log once that no jobs are taken, and once that they are taken again."""
        if reason and not self._pausing:
            log.warning("worker %s: takes no jobs: %s", self._name, reason)
        elif self._pausing and not reason:
            log.warning("worker %s: takes jobs again", self._name)
        self._pausing = bool(reason)

    def waiting(self, ahead: Mapping[str, str]) -> None:
        """Log once for each scene why its jobs are skipped, and once that they are taken again."""
        for scene_id in ahead.keys() - self._waiting:
            log.warning("worker %s: takes no jobs of scene %s: %s", self._name, scene_id, ahead[scene_id])
        for scene_id in self._waiting - ahead.keys():
            log.warning("worker %s: takes jobs of scene %s again", self._name, scene_id)
        self._waiting = set(ahead)
