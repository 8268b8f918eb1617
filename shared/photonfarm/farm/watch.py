"""A farm looked at again and again: how far each scene is, how fast, and what holds it up.

A look costs one listing of the markers of each scene, the markers that are new, and a few questions to Redis.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from photonfarm.core.errors import StoreError
from photonfarm.farm.running_farm import RunningFarm, running_farm
from photonfarm.farm.status import NoQueue, StoreQueue, Wait, queue_now, waits
from photonfarm.farm.training import RunFolder, TrainingProgress
from photonfarm.queue import Activity, RenderArguments
from photonfarm.store import SceneStore, Store

WINDOW_S = 120.0
"""The span over which a pace is taken."""

STEADY_S = 10.0
"""The least span of looks that a pace is taken from."""

CommittedAndPlanned = tuple[int, int]


@dataclass(frozen=True, slots=True)
class SceneView:
    """How far a scene is."""

    scene_id: str
    name: str
    samples: CommittedAndPlanned = (0, 0)  # without further passes
    passes: CommittedAndPlanned = (0, 0)  # further ones, of views that have samples
    jobs: CommittedAndPlanned = (0, 0)
    in_hand: int = 0  # samples that are rendered, in jobs that are not committed yet
    size_bytes: int = 0  # of the committed jobs, without guides
    core_s: float = 0.0  # that they took
    rate: float | None = None  # samples per second, lately
    left_s: float | None = None
    error: str | None = None  # why it cannot be read

    @property
    def missing(self) -> int:
        """The samples and passes that are planned and not committed."""
        return self.samples[1] - self.samples[0] + self.passes[1] - self.passes[0]


@dataclass(frozen=True, slots=True)
class FarmView:
    """A farm at one moment."""

    scenes: list[SceneView]
    queue: StoreQueue | NoQueue
    trainings: list[TrainingProgress]
    running: RunningFarm | None  # a `photonfarm up` of this machine that is at work on the store
    named_redis: bool  # the user has named it; else none need be there, as `photonfarm up` brings its own
    waits: list[Wait]  # what waits for what
    at_s: float  # when it was looked at, in seconds since 1970

    @property
    def activities(self) -> dict[str, Activity]:
        """What workers are doing, by their names."""
        return {} if isinstance(self.queue, NoQueue) else dict(self.queue.status.activities)


@dataclass(slots=True)
class _Seen:
    """What has been seen of a scene so far."""

    core_s: dict[int, float] = field(default_factory=dict)  # that committed jobs took, by their numbers
    size_bytes: int = 0
    history: deque[tuple[float, int]] = field(default_factory=deque)  # when so many samples were rendered


class FarmWatch:
    """Looks at a store, its queue and its trainings."""

    def __init__(
        self,
        store: Store,
        redis_url: str,
        runs: Sequence[Path] = (),
        *,
        named_redis: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take what to look at. Unless a user has `named_redis`, a `photonfarm up` at work here tells its own."""
        self._store, self._redis_url, self._named_redis, self._clock = store, redis_url, named_redis, clock
        self._runs = [RunFolder(run) for run in runs]
        self._seen: dict[str, _Seen] = {}

    @property
    def runs(self) -> list[RunFolder]:
        """The runs' folders, with their logs as they were at the last look."""
        return self._runs

    def costs(self, scene_id: str) -> dict[int, float]:
        """The core-seconds that each committed job of a scene took, as far as it has been seen."""
        return self._seen[scene_id].core_s if scene_id in self._seen else {}

    def look(self) -> FarmView:
        """The farm now. Raises StoreError if the store is gone."""
        running = running_farm(self._store)
        url = self._redis_url if self._named_redis or running is None else running.redis_url
        queue = queue_now(self._store, url)
        if not self._runs and running is not None and running.run:
            self._runs.append(RunFolder(Path(running.run)))
        activities = [] if isinstance(queue, NoQueue) else list(queue.status.activities.values())
        workers = 0 if isinstance(queue, NoQueue) else queue.status.workers
        seen, failed = self._store.each(lambda scene: self._look_at(scene, activities, workers))
        scenes = [*seen.values(), *(SceneView(name, "unreadable", error=str(why)) for name, why in failed.items())]
        trainings = [run.look() for run in self._runs]
        names = {scene.scene_id: scene.name for scene in scenes}
        why = list(waits(queue, names, sum(scene.missing for scene in scenes), trainings))
        by_id = sorted(scenes, key=lambda scene: scene.scene_id)
        return FarmView(by_id, queue, trainings, running, self._named_redis, why, time.time())

    def _look_at(self, scene: SceneStore, activities: Sequence[Activity], workers: int) -> SceneView:
        seen = self._seen.setdefault(scene.scene_id, _Seen())
        progress, committed = scene.progress(), scene.committed_jobs()
        if seen.core_s.keys() - committed:  # a repair has removed some
            seen = self._seen[scene.scene_id] = _Seen()
        for job in sorted(committed - seen.core_s.keys()):
            _add(scene, job, seen)
        in_hand = sum(each.done for each in activities if _is_of(each, scene.scene_id))
        in_hand = min(in_hand, progress.planned_samples - progress.committed_samples)  # a report may be seconds old
        done = progress.committed_samples + in_hand
        rate = self._pace(seen, done)
        missing = progress.planned_samples - done
        further = progress.committed_passes, progress.planned_passes
        core_s = sum(seen.core_s.values())
        left = missing / rate if rate else None
        if left is None and workers and progress.committed_samples:
            left = missing * core_s / progress.committed_samples / workers
        return SceneView(
            scene.scene_id,
            scene.spec.name,
            (progress.committed_samples - further[0], progress.planned_samples - further[1]),
            further,
            (len(committed), scene.jobs()),
            in_hand,
            seen.size_bytes,
            core_s,
            rate,
            left if missing > 0 else None,
        )

    def _pace(self, seen: _Seen, done: int) -> float | None:
        """Samples per second, over the last looks; None while they are too few, or nothing has been rendered."""
        now = self._clock()
        seen.history.append((now, done))
        while now - seen.history[0][0] > WINDOW_S:
            seen.history.popleft()
        began, first = seen.history[0]
        return (done - first) / (now - began) if now - began >= STEADY_S and done > first else None


def _add(scene: SceneStore, job: int, seen: _Seen) -> None:
    """Add a job's marker; one that cannot be read counts as free."""
    try:
        marker = scene.marker(job)
    except StoreError:
        seen.core_s[job] = 0.0
        return
    seen.core_s[job] = marker["figures"]["core_s"]
    seen.size_bytes += sum(file["size"] for file in marker["files"].values())


def _is_of(activity: Activity, scene_id: str) -> bool:
    return activity.job is not None and RenderArguments.of(activity.job).scene_id == scene_id
