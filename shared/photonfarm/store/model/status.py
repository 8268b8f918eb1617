"""The progress of a store."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.store.model.scene_store import SceneStore
from photonfarm.store.model.store import Store, check_format, name_of


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
        name = name_of(store, scene_id) or "unreadable"
        known[scene_id] = SceneStatus(scene_id, name, 0, 0, 0, 0, 0, 0.0, 0, 0, None, error=str(error))
    return [known[scene_id] for scene_id in sorted(known)]


def scene_status(scene: SceneStore) -> SceneStatus:
    """The status of one scene, as `store_status` has it; raises StoreError if it cannot be read."""
    progress = scene.progress()
    committed = sorted(scene.committed_jobs())  # before the plans: each one's plan is there by now
    jobs, withdrawn = scene.jobs(), scene.withdrawn_jobs()
    blocks = [committed[start : start + _BLOCK] for start in range(0, len(committed), _BLOCK)]
    with ThreadPoolExecutor(_READERS) as readers:
        sums = list(readers.map(partial(_sum_markers, scene), blocks))
    errors = [error for *_, error in sums if error is not None]
    if errors and not isinstance(errors[0], CorruptError):
        check_format(scene.storage)
    return SceneStatus(
        scene.scene_id,
        scene.spec.name,
        progress.planned_samples,
        progress.committed_samples,
        jobs - len(withdrawn),
        len(committed),
        sum(size_bytes for size_bytes, *_ in sums),
        sum(core_s for _, core_s, *_ in sums),
        sum(redrawn for _, _, redrawn, *_ in sums),
        sum(unreadable for *_, unreadable, _ in sums),
        str(errors[0]) if errors else None,
        sum(job >= jobs or job in withdrawn for job in committed),
    )


def _sum_markers(scene: SceneStore, jobs: list[int]) -> tuple[int, float, int, int, StoreError | None]:
    """Of the markers of some jobs: bytes, core seconds and redrawn renders; unreadable ones, and the first error."""
    size_bytes, core_s, redrawn, errors = 0, 0.0, 0, []
    for job in jobs:
        try:
            marker = scene.marker(job)
        except StoreError as error:
            if not isinstance(error.__cause__, FileNotFoundError):  # else a repair has moved it since it was listed
                errors.append(error)
            continue
        size_bytes += sum(file["size"] for file in marker["files"].values())
        core_s += marker["figures"]["core_s"]
        redrawn += marker["figures"]["redrawn"]
    return size_bytes, core_s, redrawn, len(errors), errors[0] if errors else None
