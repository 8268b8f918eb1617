"""`status`: what a store lacks to be read whole, and what its queue does about the jobs that are missing.

What waits for what is told in sentences for `up`, `status` and the web pages, and by kind for metrics.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from photonfarm.core.errors import CorruptError, QueueError, StoreError, store_errors
from photonfarm.core.formatting import format_count
from photonfarm.store import SceneStatus, Store
from photonfarm.store.format.markers import COMMITTED
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.model.scene_store import SCENES
from photonfarm.store.model.store import FAILURES_FOLDER

if TYPE_CHECKING:
    from photonfarm.queue import Failure, FailureCause, QueueStatus

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Literal

from photonfarm.farm.training import WAITS, TrainingProgress

if TYPE_CHECKING:
    from photonfarm.queue import FailureCause, QueueStatus

ANSWER_S = 5.0
"""How long `status` waits for an answer of Redis; workers wait longer."""


RECENT_S = 300.0
"""The age up to which a commit is a sign that workers are at work: jobs are meant to take 5 to 30 s."""


@dataclass(frozen=True, slots=True)
class StoreQueue:
    """The queue of a store, and why jobs of the store failed that are still missing."""

    status: QueueStatus
    causes: list[FailureCause]
    kept: list[FailureCause] = field(default_factory=list)  # of jobs that this Redis does not know as failed


@dataclass(frozen=True, slots=True)
class NoQueue:
    """Why nothing is known of a store's queue, and what the store itself has kept of failures."""

    reason: str
    kept: list[FailureCause] = field(default_factory=list)


def queue_of(store: Store, redis_url: str) -> StoreQueue | NoQueue:
    """The queue of a store, or why nothing is known of it; raises StoreError if the store is gone.

    The queue's packages are loaded only where there is something to ask: they take as long as the rest of `status`.
    """
    if (refused := _why_refused(redis_url)) and not store.storage.names(FAILURES_FOLDER):
        return NoQueue(refused)
    from photonfarm import queue

    try:
        with queue.connect(redis_url, only_s=ANSWER_S) as connection:
            queue.check_served(connection, store)
            found = queue.queue_status(connection)
    except QueueError as error:
        return NoQueue(str(error), queue.group_causes(_read_kept_failures(store)))
    failed = {name: failure for name, failure in found.failed.items() if is_missing(store, name)}
    kept = {name: failure for name, failure in _read_kept_failures(store).items() if name not in failed}
    return StoreQueue(found, queue.group_causes(failed), queue.group_causes(kept))


def queue_now(store: Store, redis_url: str) -> StoreQueue | NoQueue:
    """What `queue_of` gives, for those who look again soon: a Redis that fails on the way tells nothing."""
    from redis import RedisError

    try:
        return queue_of(store, redis_url)
    except RedisError as error:
        return NoQueue(f"Redis failed: {error}")


def since_commit_s(store: Store) -> float | None:
    """The seconds since a job was last committed, or its marker removed: all that is seen of workers without Redis.

    They follow from the times of folders, which the store's disk sets. None without a commit, and for a bucket.
    """
    if not isinstance(store.storage, LocalStorage):
        return None
    scenes = [store.storage.root / SCENES / scene_id for scene_id in store.scene_ids()]
    with store_errors("look for the last commit", store.storage.where):
        folders = [scene / COMMITTED for scene in scenes]
        times = [folder.stat().st_mtime for folder in folders if folder.is_dir()]
    return max(0.0, time.time() - max(times)) if times else None


def _why_refused(redis_url: str) -> str | None:
    """Why there is no Redis, if nothing listens at a port or socket of this machine; None if its client must tell."""
    url = urlsplit(redis_url)
    try:
        if url.scheme == "unix" and not url.netloc:
            where = url.path
            with socket.socket(socket.AF_UNIX) as probe:
                probe.connect(where)
        elif url.scheme == "redis" and url.hostname in ("localhost", "127.0.0.1", "::1"):
            where = f"{url.hostname}:{url.port or 6379}"
            socket.create_connection((url.hostname, url.port or 6379), timeout=ANSWER_S).close()
    except (ConnectionRefusedError, FileNotFoundError) as error:
        return f"no Redis at {url.scheme}://{where}: {error.strerror}; `photonfarm redis` starts one"
    except (OSError, ValueError):
        pass
    return None


def _read_kept_failures(store: Store) -> dict[str, Failure]:
    """The failures that the store has kept, of jobs that are still missing."""
    from photonfarm import queue

    with store_errors("look for failures", store.storage.where):
        return queue.read_kept_failures(store, lambda name: is_missing(store, name))


def is_missing(store: Store, name: str) -> bool:
    """Whether a job is one of this store's, and to be rendered; False for one whose scene is damaged."""
    from photonfarm.queue import RenderArguments

    job = RenderArguments.of(name)
    with contextlib.suppress(CorruptError, IndexError):
        return store.has_scene(job.scene_id) and store.scene(job.scene_id).is_to_do(job.job)
    return False


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
        f"{scene.markers_unreadable} of {scene.jobs_committed} markers cannot be read, and size, core time and "
        f"redrawn leave them out: {scene.marker_error}; `photonfarm store check` names each"
    )


def lost_plan(scene: SceneStatus) -> str:
    """The message about a scene's markers whose jobs no plan has; "" if there are none."""
    if not scene.markers_without_plan:
        return ""
    return (
        f"{scene.markers_without_plan} of {scene.jobs_committed} markers are of jobs that no plan has; "
        "`photonfarm store check` reports whether the last plan is missing"
    )


IDLE_SHOWN = 10
"""The most reasons of idle workers that are told."""

WaitKind = Literal["scene_left", "worker_paused", "job_failed", "no_worker", "trainer_waits"]
"""What waits: scenes that workers leave, workers that take no jobs, failed jobs, samples without a worker, trainers."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Something that waits."""

    kind: WaitKind
    count: int  # of the scenes, workers, jobs, samples or trainers that wait
    sentence: str  # which of them, and for what

    def __str__(self) -> str:
        """The sentence."""
        return self.sentence


def waits(
    queue: StoreQueue | NoQueue, names: Mapping[str, str], missing: int, trainings: Sequence[TrainingProgress] = ()
) -> Iterator[Wait]:
    """Yield why workers are idle, why jobs failed, and what trainers wait for.

    `names` are those of the store's scenes, by their ids, and `missing` samples are planned and not committed.
    """
    if isinstance(queue, StoreQueue):
        yield from idle(queue.status, names, missing)
        yield from (Wait("job_failed", len(cause.jobs), describe_failed(cause)) for cause in queue.causes)
    for training in trainings:
        if training.phase == WAITS:
            why = f"{training.run}: the trainer {WAITS}" + ("" if missing else ", and all that are planned are there")
            yield Wait("trainer_waits", 1, why)


def idle(found: QueueStatus, names: Mapping[str, str], missing: int) -> Iterator[Wait]:
    """Yield why scenes are not rendered, by the workers' reports; and that none is there for `missing` samples."""
    if missing and not found.workers:
        why = (
            f"{missing} samples wait for a worker: none is alive; `photonfarm work` starts one, which also queues them"
        )
        yield Wait("no_worker", missing, why)
    for scene_id, reasons in found.left.items():
        if scene_id in names:
            reason = next(iter(reasons.values()))
            why = f"{names[scene_id]}: left by {len(reasons)} of {found.workers} workers: {reason}"
            yield Wait("scene_left", 1, why)
    paused: dict[str, list[str]] = {}
    for worker, reason in found.paused.items():
        paused.setdefault(reason, []).append(worker)
    for reason, workers in list(paused.items())[:IDLE_SHOWN]:
        who = f"worker {workers[0]} takes" if len(workers) == 1 else f"{len(workers)} workers take"
        yield Wait("worker_paused", len(workers), f"{who} no jobs: {reason}")
    if more := list(paused.values())[IDLE_SHOWN:]:
        yield Wait("worker_paused", sum(map(len, more)), f"and {len(more)} reasons more")


def describe_failed(cause: FailureCause) -> str:
    """How many jobs failed, and why."""
    aside = f", {cause.set_aside} of them set aside until `photonfarm submit --retry`" if cause.set_aside else ""
    return f"{format_count(len(cause.jobs), 'job')} failed{aside}: {cause.cause}"
