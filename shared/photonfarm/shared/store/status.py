"""How far a store is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from photonfarm.shared.errors import StoreError
from photonfarm.shared.store.scene_store import SceneStore
from photonfarm.shared.store.store import Store


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """Planned and done, of one scene."""

    scene_id: str
    name: str
    samples_planned: int
    samples_complete: int
    jobs_planned: int
    jobs_committed: int
    size_bytes: int  # of the committed outputs
    core_s: float  # processor time of the committed jobs
    redrawn: int  # renders thrown away for a non-finite value
    error: str | None = None  # why nothing is known of it; all numbers are 0 then


_READERS = 8
"""Markers read at a time: a bucket answers after milliseconds, whoever asks."""

_BLOCK = 256
"""Markers that a reader takes at a time, and forgets once they are summed up."""


def store_status(store: Store) -> list[SceneStatus]:
    """The status of every scene; reads every marker, and holds few of them at a time.

    A scene that cannot be read says why, by its `error`. Raises StoreError if the store cannot be read.
    """
    known, failed = store.each(_scene_status)
    for scene_id, error in failed.items():
        known[scene_id] = SceneStatus(scene_id, _name(store, scene_id), 0, 0, 0, 0, 0, 0.0, 0, str(error))
    return [known[scene_id] for scene_id in sorted(known)]


def _name(store: Store, scene_id: str) -> str:
    """A scene's name, if its spec can be read."""
    try:
        return store.scene(scene_id).spec.name
    except StoreError:
        return "unreadable"


def _scene_status(scene: SceneStore) -> SceneStatus:
    progress = scene.progress()
    committed = sorted(scene.committed_jobs())
    with ThreadPoolExecutor(_READERS) as readers:
        blocks = [committed[start : start + _BLOCK] for start in range(0, len(committed), _BLOCK)]
        sums = list(readers.map(partial(_sums, scene), blocks))
    return SceneStatus(
        scene.scene_id,
        scene.spec.name,
        progress.planned_samples,
        progress.committed_samples,
        scene.jobs(),
        len(committed),
        sum(size_bytes for size_bytes, _, _ in sums),
        sum((core_s for _, core_s, _ in sums), 0.0),
        sum(redrawn for _, _, redrawn in sums),
    )


def _sums(scene: SceneStore, jobs: list[int]) -> tuple[int, float, int]:
    """Bytes, processor seconds and renders thrown away of some committed jobs."""
    size_bytes, core_s, redrawn = 0, 0.0, 0
    for job in jobs:
        marker = scene.marker(job)
        size_bytes += sum(file["size"] for file in marker["files"].values())
        core_s += marker["figures"]["core_s"]
        redrawn += marker["figures"]["redrawn"]
    return size_bytes, core_s, redrawn
