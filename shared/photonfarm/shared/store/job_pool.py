"""Checks several jobs at a time: reading, checksums and arithmetic run beside each other."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self

from photonfarm.shared.store.content_check import Tally
from photonfarm.shared.store.findings import Finding
from photonfarm.shared.store.halves import HalvesTest
from photonfarm.shared.store.job_check import Checked, JobCheck

MOST_THREADS = 4
"""More of them would wait for the disk, or for each other."""


class JobPool:
    """Threads that check jobs, each with memory of its own; a context manager."""

    def __init__(self, scene: Checked, scenes: int) -> None:
        self.tallies: list[Tally] = []
        self._own = threading.local()
        self._scene = scene
        self._scenes = scenes
        self._threads = ThreadPoolExecutor(min(MOST_THREADS, _cores()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.shutdown(cancel_futures=True)

    @property
    def size_bytes(self) -> int:
        """Bytes read so far."""
        return sum(tally.size_bytes for tally in self.tallies)

    def run(self, jobs: list[int]) -> Iterator[tuple[list[Finding], bytes]]:
        """What is found of each job, and its marker, in order."""
        return self._threads.map(self._check, jobs)

    def _check(self, job: int) -> tuple[list[Finding], bytes]:
        if not hasattr(self._own, "check"):
            tally = Tally(HalvesTest(self._scenes))
            self.tallies.append(tally)
            self._own.check = JobCheck(self._scene, tally)
        found: tuple[list[Finding], bytes] = self._own.check.run(job)
        return found


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
