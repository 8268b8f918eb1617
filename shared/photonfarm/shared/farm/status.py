"""`status`: what a store lacks to be read whole, and what its queue does about the jobs that are missing."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from photonfarm.shared import queue
from photonfarm.shared.core.errors import CorruptError, QueueError, StoreError
from photonfarm.shared.queue import Failure, FailureCause, QueueStatus, RenderArguments
from photonfarm.shared.store import SceneStatus, Store

ANSWER_S = 5.0
"""How long `status` waits for an answer of Redis; workers wait longer."""


@dataclass(frozen=True, slots=True)
class StoreQueue:
    """The queue of a store, and why jobs of the store failed that are still missing."""

    status: QueueStatus
    causes: list[FailureCause]


@dataclass(frozen=True, slots=True)
class NoQueue:
    """Why nothing is known of a store's queue."""

    reason: str


def queue_of(store: Store, redis_url: str) -> StoreQueue | NoQueue:
    """The queue of a store, or why nothing is known of it; raises StoreError if the store is gone."""
    try:
        with queue.connect(redis_url, only_s=ANSWER_S) as connection:
            queue.check_served(connection, store)
            found = queue.queue_status(connection)
    except QueueError as error:
        return NoQueue(str(error))
    return StoreQueue(found, queue.causes(_still_missing(store, found.failed)))


def _still_missing(store: Store, failed: Mapping[str, Failure]) -> dict[str, Failure]:
    """The failures of this store's jobs that are still not committed."""
    scene_ids, missing = set(store.scene_ids()), {}
    for name, failure in failed.items():
        job = RenderArguments.of(name)
        with contextlib.suppress(CorruptError):  # of a scene whose spec is damaged
            if job.scene_id in scene_ids and not store.scene(job.scene_id).is_done(job.job):
                missing[name] = failure
    return missing


def check_read(scenes: Sequence[SceneStatus]) -> None:
    """Raise StoreError if a scene or a marker could not be read, or a marker belongs to no plan."""
    unread = []
    if unreadable := [scene.error for scene in scenes if scene.error]:
        unread.append(f"{len(unreadable)} of {len(scenes)} scenes cannot be read: {'; '.join(unreadable)}")
    for about in (unread_markers, lost_plan):
        unread += [f"scene {scene.scene_id}: {message}" for scene in scenes if (message := about(scene))]
    if unread:
        raise StoreError("; ".join(unread))


def unread_markers(scene: SceneStatus) -> str:
    """The message about a scene's unreadable markers; "" if there are none."""
    if not scene.markers_unreadable:
        return ""
    return (
        f"{scene.markers_unreadable} of {_markers(scene)} markers cannot be read, and size, core time and "
        f"redrawn leave them out: {scene.marker_error}; `photonfarm store check` names each"
    )


def lost_plan(scene: SceneStatus) -> str:
    """The message about a scene's markers whose jobs no plan has; "" if there are none."""
    if not scene.markers_without_plan:
        return ""
    return (
        f"{scene.markers_without_plan} of {_markers(scene)} markers are of jobs that no plan has; "
        "`photonfarm store check` reports whether the last plan is missing"
    )


def _markers(scene: SceneStatus) -> int:
    """The number of a scene's markers, including those of guides."""
    return scene.jobs_committed + scene.guide_jobs
