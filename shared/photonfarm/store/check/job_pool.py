"""Checks several jobs at a time: reading, checksums and arithmetic run beside each other."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self

from photonfarm.core.processes import usable_cores
from photonfarm.store.check.content_check import CheckTotals, HalvesTest
from photonfarm.store.check.job_check import CheckTarget, JobCheck
from photonfarm.store.io.storage import renew_copy
from photonfarm.store.model.findings import Cause, Finding

MOST_THREADS = 4
"""The most threads: more would wait for the disk, or for each other."""


class JobPool:
    """Threads that check jobs, each with memory of its own; a context manager."""

    def __init__(self, scene: CheckTarget, scenes: int) -> None:
        self.totals: list[CheckTotals] = []
        self._own = threading.local()
        self._scene = scene
        self._scenes = scenes
        self._threads = ThreadPoolExecutor(min(MOST_THREADS, usable_cores()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.shutdown(cancel_futures=True)

    @property
    def size_bytes(self) -> int:
        """Bytes read so far."""
        return sum(each.size_bytes for each in self.totals)

    def run(self, jobs: list[int]) -> Iterator[tuple[list[Finding], bytes]]:
        """The findings of each job, and its marker, in order."""
        return self._threads.map(self._check, jobs)

    def _check(self, job: int) -> tuple[list[Finding], bytes]:
        if not hasattr(self._own, "checker"):
            self._own.checker = _Checker(self._scene, self._scenes)
            self.totals.append(self._own.checker.totals)
        found: tuple[list[Finding], bytes] = self._own.checker.run(job)
        return found


class _Checker:
    """Checks jobs of a scene one after the other, and distinguishes damage of the store from damage of local copies."""

    def __init__(self, scene: CheckTarget, scenes: int) -> None:
        self.totals = CheckTotals(HalvesTest(scenes))
        self._scene = scene
        self._scenes = scenes
        self._check = JobCheck(scene)

    def run(self, job: int) -> tuple[list[Finding], bytes]:
        """The findings of a job, and its marker; damaged local copies are replaced and read again first."""
        found, marker, totals = self._run(job)
        if self._renewed(found):
            found, marker, totals = self._run(job)
        self.totals.add(totals)
        return found, marker

    def _run(self, job: int) -> tuple[list[Finding], bytes, CheckTotals]:
        totals = CheckTotals(HalvesTest(self._scenes))  # of this job alone: one that is checked again counts once
        return *self._check.run(job, totals), totals

    def _renewed(self, found: list[Finding]) -> bool:
        """Replace the local copies of files with wrong checksums; returns whether there were any."""
        damaged = {finding.file for finding in found if finding.cause is Cause.CHECKSUM and finding.file}
        renewed = [renew_copy(self._scene.storage, file) for file in sorted(damaged)]
        return any(renewed)
