"""How far a store is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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


def store_status(store: Store) -> list[SceneStatus]:
    """The status of every scene; reads every marker."""
    return [_scene_status(scene) for scene in store.scenes()]


def _scene_status(scene: SceneStore) -> SceneStatus:
    progress = scene.progress()
    committed = scene.committed_jobs()
    markers = [scene.marker(job) for job in sorted(committed)]
    sizes = [file["size"] for marker in markers for file in marker["files"].values()]
    return SceneStatus(
        scene.scene_id,
        scene.spec.name,
        progress.planned_samples,
        progress.committed_samples,
        scene.jobs(),
        len(committed),
        int(np.sum(sizes, dtype=np.int64)),
        float(sum(marker["figures"]["core_s"] for marker in markers)),
        sum(marker["figures"]["redrawn"] for marker in markers),
    )
