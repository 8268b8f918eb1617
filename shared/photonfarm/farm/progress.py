"""How far a farm is: one value, which `status`, `up`, the web pages and the metrics show, and what it says in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from photonfarm.core.errors import StoreError
from photonfarm.core.formatting import format_count
from photonfarm.farm.running_farm import RunningFarm
from photonfarm.farm.training import WAITS, TrainingProgress
from photonfarm.store import SceneStatus

if TYPE_CHECKING:
    from photonfarm.queue.failures import FailureCause
    from photonfarm.queue.rq_adapter import QueueStatus
    from photonfarm.queue.workers import Activity

CommittedAndPlanned = tuple[int, int]


@dataclass(frozen=True, slots=True)
class SceneProgress:
    """How far a scene is."""

    status: SceneStatus  # what is planned and committed, with further passes
    passes: CommittedAndPlanned = (0, 0)  # of these samples, further passes of views that have others
    in_hand: int = 0  # samples that are rendered, in jobs that are not committed yet
    rate: float | None = None  # samples per second, lately
    left_s: float | None = None

    @property
    def samples(self) -> CommittedAndPlanned:
        """The samples without further passes."""
        return self.status.samples_complete - self.passes[0], self.status.samples_planned - self.passes[1]

    @property
    def missing(self) -> int:
        """The samples and passes that are planned and not committed."""
        return self.status.samples_planned - self.status.samples_complete

    @property
    def faults(self) -> list[str]:
        """Why the scene or some of its markers cannot be read, and that markers belong to no plan, in sentences."""
        status, faults = self.status, []
        if status.error:
            faults.append(f"cannot be read: {status.error}")
        if status.markers_unreadable:
            faults.append(
                f"{status.markers_unreadable} of {status.jobs_committed} markers cannot be read, and size, core time "
                f"and redrawn leave them out: {status.marker_error}; `photonfarm store check` names each"
            )
        if status.markers_without_plan:
            faults.append(
                f"{status.markers_without_plan} of {status.jobs_committed} markers are of jobs that no plan has; "
                "`photonfarm store check` reports whether the last plan is missing"
            )
        return faults


@dataclass(frozen=True, slots=True)
class QueueProgress:
    """The queue of a store, and why jobs failed that are still missing."""

    status: QueueStatus | None  # None: nothing is known of it
    reason: str = ""  # why not
    causes: list[FailureCause] = field(default_factory=list)
    kept: list[FailureCause] = field(default_factory=list)  # of jobs that this Redis does not know as failed

    @property
    def activities(self) -> dict[str, Activity]:
        """What workers are doing, by their names."""
        return dict(sorted(self.status.activities.items())) if self.status else {}


WaitKind = Literal["scene_left", "worker_paused", "job_failed", "no_worker", "trainer_waits"]
"""What waits: scenes that workers leave, workers that take no jobs, failed jobs, samples without a worker, trainers."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Something that waits."""

    kind: WaitKind
    count: int  # of the scenes, workers, jobs, samples or trainers that wait
    sentence: str  # which of them, and for what


@dataclass(frozen=True, slots=True)
class FarmProgress:
    """How far a farm is."""

    scenes: list[SceneProgress]
    queue: QueueProgress
    trainings: list[TrainingProgress]
    running: RunningFarm | None = None  # a `photonfarm up` of this machine that is at work on the store
    named_redis: bool = True  # the user has named it; else none need be there, as `photonfarm up` brings its own
    at_s: float = 0.0  # when it was looked at, in seconds since 1970

    @property
    def missing(self) -> int:
        """The samples and passes of all scenes that are planned and not committed."""
        return sum(scene.missing for scene in self.scenes)

    @property
    def waits(self) -> list[Wait]:
        """What waits for what."""
        return list(_find_waits(self))

    def describe_queue(self) -> str:
        """What the queue holds, or what it means that nothing is known of one."""
        missing, status = self.missing, self.queue.status
        if status is not None:
            failed = sum(len(cause.jobs) for cause in self.queue.causes)
            jobs = format_count(status.queued, "job")
            return f"{jobs} queued, {status.running} running, {format_count(status.workers, 'worker')}, {failed} failed"
        if self.named_redis:
            return self.queue.reason
        if not missing:
            return "none is needed: all that is planned is there"
        if any(scene.rate for scene in self.scenes):
            return "none is known here; workers without Redis are at work (`work --share`, `slurm`)"
        return (
            "no farm is known here; workers without Redis are seen by what they commit (`status --watch`). `photonfarm "
            f"up` goes on with the missing {format_count(missing, 'sample')}, given the spec, and `photonfarm work "
            "--share 0/1 --until-complete` renders just these"
        )

    def check_read(self) -> None:
        """Raise StoreError if a scene or a marker could not be read, or a marker belongs to no plan."""
        unread = [scene.status.error for scene in self.scenes if scene.status.error]
        faults = [f"{len(unread)} of {len(self.scenes)} scenes cannot be read: {'; '.join(unread)}"] if unread else []
        for scene in self.scenes:
            if not scene.status.error:
                faults += [f"scene {scene.status.scene_id}: {fault}" for fault in scene.faults]
        if faults:
            raise StoreError("; ".join(faults))


def _find_waits(farm: FarmProgress) -> Iterator[Wait]:
    """Yield why workers are idle, why jobs failed, and what trainers wait for."""
    names = {scene.status.scene_id: scene.status.name for scene in farm.scenes}
    missing, status = farm.missing, farm.queue.status
    if status is not None:
        if missing and not status.workers and farm.running is None:
            how = "none is alive; `photonfarm work` starts one, which also queues them"
            yield Wait("no_worker", missing, f"{format_count(missing, 'sample')} without a worker: {how}")
        for scene_id, reasons in status.skipped.items():
            if scene_id in names:
                left = f"left by {len(reasons)} of {status.workers} workers: {next(iter(reasons.values()))}"
                yield Wait("scene_left", 1, f"{names[scene_id]}: {left}")
        paused: dict[str, list[str]] = {}
        for worker, reason in status.paused.items():
            paused.setdefault(reason, []).append(worker)
        for reason, workers in paused.items():
            who = f"worker {workers[0]} takes" if len(workers) == 1 else f"{len(workers)} workers take"
            yield Wait("worker_paused", len(workers), f"{who} no jobs: {reason}")
        yield from (Wait("job_failed", len(cause.jobs), describe_failed(cause)) for cause in farm.queue.causes)
    for training in farm.trainings:
        if training.phase == WAITS:
            why = "" if missing else ", and all that are planned are there"
            yield Wait("trainer_waits", 1, f"{training.run}: the trainer {WAITS}{why}")


def describe_failed(cause: FailureCause) -> str:
    """How many jobs failed, and why."""
    aside = f", {cause.set_aside} of them set aside until `photonfarm submit --retry`" if cause.set_aside else ""
    return f"{format_count(len(cause.jobs), 'job')} failed{aside}: {cause.cause}"
