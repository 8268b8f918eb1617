"""What waits for what, in sentences for `up`, `status` and the web pages, and by kind for metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from photonfarm.shared.farm.status import NoQueue, StoreQueue
from photonfarm.shared.farm.training import WAITS, TrainingProgress

if TYPE_CHECKING:
    from photonfarm.shared.queue import FailureCause, QueueStatus

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
        yield from idle(queue.status, names)
        yield from (Wait("job_failed", len(cause.jobs), failed(cause)) for cause in queue.causes)
        if missing and not queue.status.workers:
            why = f"{missing} samples wait for a worker: none is alive; `photonfarm work` starts one"
            yield Wait("no_worker", missing, why)
    for training in trainings:
        if training.phase == WAITS:
            why = f"{training.run}: the trainer {WAITS}" + ("" if missing else ", and all that are planned are there")
            yield Wait("trainer_waits", 1, why)


def idle(found: QueueStatus, names: Mapping[str, str]) -> Iterator[Wait]:
    """Yield why scenes are not rendered, by the workers' reports."""
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


def failed(cause: FailureCause) -> str:
    """How many jobs failed, and why."""
    aside = f", {cause.set_aside} of them set aside until `photonfarm submit --retry`" if cause.set_aside else ""
    return f"{len(cause.jobs)} job{'s' * (len(cause.jobs) != 1)} failed{aside}: {cause.cause}"
