"""A farm looked at again and again.

A look costs one listing of the markers of each scene, the markers that are new, and a few questions to Redis.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from photonfarm.core.errors import CorruptError, QueueError, StoreError, store_errors
from photonfarm.farm.progress import FarmProgress, QueueProgress, SceneProgress
from photonfarm.farm.running_farm import running_farm
from photonfarm.farm.training import RunFolder
from photonfarm.store import SceneStatus, SceneStore, Store
from photonfarm.store.model.store import FAILURES_FOLDER, READERS, name_of

if TYPE_CHECKING:
    from photonfarm.queue.failures import Failure
    from photonfarm.queue.workers import Activity

ANSWER_S = 5.0
"""How long an answer of Redis is waited for; workers wait longer."""

WINDOW_S = 120.0
"""The span over which a pace is taken."""

STEADY_S = 10.0
"""The least span of looks that a pace is taken from."""


@dataclass(slots=True)
class _Seen:
    """What has been seen of a scene so far."""

    core_s: dict[int, float] = field(default_factory=dict)  # that committed jobs took, by their numbers
    size_bytes: int = 0
    redrawn: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    history: deque[tuple[float, int]] = field(default_factory=deque)  # when so many samples were rendered

    def add(self, job: int, marker: dict[str, Any]) -> None:
        """Add a job's marker."""
        self.core_s[job] = marker["figures"]["core_s"]
        self.redrawn += marker["figures"]["redrawn"]
        self.counts.update(marker["figures"].get("counts", {}))
        self.size_bytes += sum(file["size"] for file in marker["files"].values())

    def pace(self, now: float, rendered: int) -> float | None:
        """Samples per second, over the last looks; None while they are too few, or nothing has been rendered."""
        self.history.append((now, rendered))
        while now - self.history[0][0] > WINDOW_S:
            self.history.popleft()
        began, first = self.history[0]
        return (rendered - first) / (now - began) if now - began >= STEADY_S and rendered > first else None


class FarmWatch:
    """Looks at a store, its queue and its trainings."""

    def __init__(
        self,
        store: Store,
        redis_url: str,
        runs: Sequence[Path] = (),
        *,
        scene_id: str | None = None,
        named_redis: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take what to look at, which may be one scene alone.

        Unless a user has `named_redis`, a `photonfarm up` at work here tells its own.
        """
        self._store, self._redis_url, self._named_redis, self._clock = store, redis_url, named_redis, clock
        self._scene_id = scene_id
        self.runs = [RunFolder(run) for run in runs]
        self._seen: dict[str, _Seen] = {}

    def costs(self, scene_id: str) -> dict[int, float]:
        """The core-seconds that each committed job of a scene took, as far as it has been seen."""
        return self._seen[scene_id].core_s if scene_id in self._seen else {}

    def look(self) -> FarmProgress:
        """The farm now. Raises StoreError if the store is gone."""
        running = running_farm(self._store)
        url = self._redis_url if self._named_redis or running is None else running.redis_url
        queue = read_queue(self._store, url)
        if not self.runs and running is not None and running.run:
            self.runs.append(RunFolder(Path(running.run)))
        if self._scene_id is None:
            scenes, failed = self._store.each(lambda scene: self._look_at(scene, queue))
        else:
            scenes, failed = {self._scene_id: self._look_at(self._store.scene(self._scene_id), queue)}, {}
        for scene_id, error in failed.items():
            name = name_of(self._store, scene_id) or "unreadable"
            scenes[scene_id] = SceneProgress(
                SceneStatus(scene_id, name, 0, 0, 0, 0, 0, 0.0, 0, 0, None, error=str(error))
            )
        return FarmProgress(
            [scenes[scene_id] for scene_id in sorted(scenes)],
            queue,
            [run.look() for run in self.runs],
            running,
            self._named_redis,
            time.time(),
        )

    def _look_at(self, scene: SceneStore, queue: QueueProgress) -> SceneProgress:
        committed = scene.committed_jobs()
        progress = scene.progress_of(committed)
        jobs, withdrawn = scene.jobs(), scene.withdrawn_jobs()  # after the markers: each one's plan is there by now
        seen = self._seen.get(scene.scene_id)
        if seen is None or seen.core_s.keys() - committed:  # a repair has removed some
            seen = self._seen[scene.scene_id] = _Seen()
        new, unread = sorted(committed - seen.core_s.keys()), []
        with ThreadPoolExecutor(READERS) as readers:
            for job, marker in zip(new, readers.map(partial(_read_marker, scene), new), strict=True):
                if not isinstance(marker, StoreError):
                    seen.add(job, marker)
                elif not isinstance(marker.__cause__, FileNotFoundError):  # else a repair has moved it since
                    unread.append(marker)  # it is tried again at the next look
        if any(not isinstance(error, CorruptError) for error in unread):
            self._store.check()
        complete, planned = progress.committed_samples, progress.planned_samples
        told = sum(each.done for each in queue.activities.values() if _is_of(each, scene.scene_id))
        in_hand = min(told, planned - complete)  # a report may be seconds old
        missing, core_s = planned - complete - in_hand, sum(seen.core_s.values(), 0.0)
        rate, left_s = seen.pace(self._clock(), complete + in_hand), None
        if rate:
            left_s = missing / rate
        elif queue.status and queue.status.workers and complete:
            left_s = missing * core_s / complete / queue.status.workers
        return SceneProgress(
            SceneStatus(
                scene.scene_id,
                scene.spec.name,
                planned,
                complete,
                jobs - len(withdrawn),
                len(committed),
                seen.size_bytes,
                core_s,
                seen.redrawn,
                len(unread),
                str(unread[0]) if unread else None,
                sum(job >= jobs or job in withdrawn for job in committed),
                counts=dict(seen.counts),
            ),
            (progress.committed_passes, progress.planned_passes),
            in_hand,
            rate,
            left_s if missing else None,
        )


def _read_marker(scene: SceneStore, job: int) -> dict[str, Any] | StoreError:
    try:
        return scene.marker(job)
    except StoreError as error:
        return error


def _is_of(activity: Activity, scene_id: str) -> bool:
    from photonfarm.queue.job import RenderArguments

    return activity.job is not None and RenderArguments.of(activity.job).scene_id == scene_id


def read_queue(store: Store, redis_url: str) -> QueueProgress:
    """The queue of a store, or why nothing is known of it; raises StoreError if the store is gone.

    The queue's packages are loaded only where there is something to ask: they take as long as the rest of `status`.
    """
    if (refused := _why_refused(redis_url)) and not store.storage.names(FAILURES_FOLDER):
        return QueueProgress(None, refused)
    from photonfarm.queue.connection import connect, redis_errors
    from photonfarm.queue.failures import group_causes, read_kept_failures
    from photonfarm.queue.rq_adapter import queue_status
    from photonfarm.queue.workers import check_served

    with store_errors("look for failures", store.storage.where):
        kept = read_kept_failures(store, lambda name: _is_missing(store, name))
    try:
        with redis_errors("asked"), connect(redis_url, only_s=ANSWER_S) as connection:
            check_served(connection, store)
            status = queue_status(connection)
    except QueueError as error:
        return QueueProgress(None, str(error), kept=group_causes(kept))
    failed = {name: failure for name, failure in status.failed.items() if _is_missing(store, name)}
    unknown: dict[str, Failure] = {name: failure for name, failure in kept.items() if name not in failed}
    return QueueProgress(status, causes=group_causes(failed), kept=group_causes(unknown))


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


def _is_missing(store: Store, name: str) -> bool:
    """Whether a job is one of this store's, and to be rendered; False for one whose scene is damaged."""
    from photonfarm.queue.job import RenderArguments

    job = RenderArguments.of(name)
    with contextlib.suppress(CorruptError, IndexError):
        return store.has_scene(job.scene_id) and store.scene(job.scene_id).is_to_do(job.job)
    return False
