"""`photonfarm store upgrade`: scenes of older stores get guides, and no sample is rendered again.

The upgrade writes only one small file for each scene, which requests guides; workers render them as missing jobs. So it
may be interrupted at any point, and repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.farm.submission import queue_missing
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.store import SceneStore, Store
from photonfarm.shared.store.format.schema import most_guide_bytes
from photonfarm.shared.store.read.find import scene_named
from photonfarm.shared.store.write.guides import jobs_with_views
from photonfarm.shared.store.write.status import scene_status


@dataclass(frozen=True, slots=True)
class SceneUpgrade:
    """The progress of one scene's guides."""

    scene_id: str
    name: str
    asked: bool  # requested now, or would be; False: requested before
    light_samples: int  # of the settings that they are rendered with
    views: int  # planned
    views_lacking: int  # the planned views without guides
    jobs_lacking: int  # jobs to render for these views
    bytes_per_sample: float | None  # of what is stored, without guides; None while no sample is complete
    guide_bytes_per_sample: float  # that guides of all views add, at most


@dataclass(frozen=True, slots=True)
class Upgrade:
    """The outcome of an upgrade."""

    scenes: tuple[SceneUpgrade, ...]
    queued: int | None  # jobs queued, with those that were missing before; None: not queued
    dry_run: bool  # nothing was written
    failed: dict[str, str]  # why scenes cannot be upgraded, by scene id


def upgrade(
    store: str | Path,
    redis_url: str | None,
    *,
    scene: str | None = None,
    light_samples: int | None = None,
    dry_run: bool = False,
) -> Upgrade:
    """Request guides for every scene of a store, or for one, and queue missing jobs unless `redis_url` is None.

    A scene whose guides were requested before keeps its settings. Damage of one scene does not affect the others.
    Raises SpecError for an invalid number of light samples, StoreError for a store or the one scene that cannot be
    read, and QueueError; in the last case the request is kept, and idle workers queue the jobs later.
    """
    wanted, opened = _wanted(light_samples), Store(store)
    scene_id = None if scene is None else scene_named(opened, scene)
    if scene_id is not None:
        done, failed = {scene_id: _scene_upgrade(opened.scene(scene_id), wanted, dry_run=dry_run)}, {}
    else:
        done, errors = opened.each(lambda each: _scene_upgrade(each, wanted, dry_run=dry_run))
        failed = {each: str(error) for each, error in errors.items()}
    queued = None
    if redis_url is not None and not dry_run:
        stored = "The wish for guides is stored"
        queued = queue_missing(opened, redis_url, scene_id=scene_id, stored=stored, verb="upgrades")
    return Upgrade(tuple(done.values()), queued, dry_run, failed)


def _wanted(light_samples: int | None) -> GuideSpec:
    try:
        return GuideSpec() if light_samples is None else GuideSpec(light_samples=light_samples)
    except ValueError as error:
        raise SpecError(f"light_samples = {light_samples}: 0 to 64 are allowed") from error


def _scene_upgrade(scene: SceneStore, wanted: GuideSpec, *, dry_run: bool) -> SceneUpgrade:
    """Request guides unless they were requested before; returns their progress."""
    asked = scene.guides.settings() is None if dry_run else scene.guides.ask(wanted)
    settings = scene.guides.settings() or wanted
    status, found = scene_status(scene), scene.plans()
    jobs = len(jobs_with_views(found))
    most = most_guide_bytes(scene.spec, status.views_planned, jobs, found[0].shard_rows) if found else 0
    samples = status.size_bytes - status.guide_bytes
    return SceneUpgrade(
        scene.scene_id,
        scene.spec.name,
        asked,
        settings.light_samples,
        status.views_planned,
        status.views_planned - (status.views_guided or 0),
        len(scene.guides.without(found)),
        samples / status.samples_complete if status.samples_complete else None,
        most / max(status.samples_planned, 1),
    )
