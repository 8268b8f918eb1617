"""The progress of a store."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.store.model.scene_store import SceneStore
from photonfarm.store.model.store import Store, check_format


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """The planned and the committed amounts of one scene."""

    scene_id: str
    name: str
    samples_planned: int
    samples_complete: int
    jobs_planned: int
    jobs_committed: int
    size_bytes: int  # of the committed outputs
    core_s: float  # processor time of the committed jobs
    redrawn: int  # renders thrown away for a non-finite value
    markers_unreadable: int  # of committed jobs whose bytes, time and redrawn renders are not counted
    marker_error: str | None  # why the first of these cannot be read
    markers_without_plan: int = 0  # of committed jobs that no plan has: the last plan is missing
    error: str | None = None  # why the scene cannot be read; all numbers are 0 then


_READERS = 8
"""The number of markers read at a time: a bucket takes milliseconds for each answer."""

_BLOCK = 256
"""The number of markers that a reader takes at a time, and forgets once they are summed up."""


def store_status(store: Store) -> list[SceneStatus]:
    """The status of every scene; reads every marker, and holds few of them at a time.

    A scene that cannot be read has an `error`, and unreadable markers are counted by themselves. Raises StoreError if
    the store cannot be read.
    """
    known, failed = store.each(scene_status)
    for scene_id, error in failed.items():
        known[scene_id] = SceneStatus(
            scene_id, _name(store, scene_id), 0, 0, 0, 0, 0, 0.0, 0, 0, None, error=str(error)
        )
    return [known[scene_id] for scene_id in sorted(known)]


def _name(store: Store, scene_id: str) -> str:
    """A scene's name, if its spec can be read."""
    try:
        return store.scene(scene_id).spec.name
    except StoreError:
        return "unreadable"


def scene_status(scene: SceneStore) -> SceneStatus:
    """The status of one scene, as `store_status` has it; raises StoreError if it cannot be read."""
    progress = scene.progress()
    committed = sorted(scene.committed_jobs())  # before the plans: each one's plan is there by now
    jobs, withdrawn, sums = scene.jobs(), scene.withdrawn_jobs(), _sum_all(scene.marker, committed)
    if sums.error is not None and not isinstance(sums.error, CorruptError):
        check_format(scene.storage)
    return SceneStatus(
        scene.scene_id,
        scene.spec.name,
        progress.planned_samples,
        progress.committed_samples,
        jobs - len(withdrawn),
        len(committed),
        sums.size_bytes,
        sums.core_s,
        sums.redrawn,
        sums.unreadable,
        str(sums.error) if sums.error else None,
        sum(job >= jobs or job in withdrawn for job in committed),
    )


@dataclass(slots=True)
class _Sums:
    """Sums over the markers of some committed jobs."""

    size_bytes: int = 0
    core_s: float = 0.0
    redrawn: int = 0
    unreadable: int = 0  # markers
    error: StoreError | None = None  # of the first of these

    def add(self, other: _Sums) -> None:
        """Add the sums over other markers."""
        for name in ("size_bytes", "core_s", "redrawn", "unreadable"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.error = self.error or other.error


Read = Callable[[int], dict[str, Any]]
"""A function that reads the marker of a job."""


def _sum_all(read: Read, committed: list[int]) -> _Sums:
    """Sums over the markers of many jobs, read several at a time."""
    blocks = [committed[start : start + _BLOCK] for start in range(0, len(committed), _BLOCK)]
    sums = _Sums()
    with ThreadPoolExecutor(_READERS) as readers:
        for each in readers.map(partial(_sum, read), blocks):
            sums.add(each)
    return sums


def _sum(read: Read, jobs: Iterable[int]) -> _Sums:
    sums = _Sums()
    for job in jobs:
        try:
            marker = read(job)
        except StoreError as error:
            if not isinstance(error.__cause__, FileNotFoundError):  # else a repair has moved it since it was listed
                sums.unreadable += 1
                sums.error = sums.error or error
            continue
        sums.size_bytes += sum(file["size"] for file in marker["files"].values())
        sums.core_s += marker["figures"]["core_s"]
        sums.redrawn += marker["figures"]["redrawn"]
    return sums
