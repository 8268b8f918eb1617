"""What waits for what, in sentences: for `up`, `status` and the web pages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from photonfarm.shared.farm.status import NoQueue, StoreQueue
from photonfarm.shared.farm.training import WAITS, TrainingProgress

if TYPE_CHECKING:
    from photonfarm.shared.queue import FailureCause, QueueStatus

IDLE_SHOWN = 10
"""The most reasons of idle workers that are told."""


def waits(
    queue: StoreQueue | NoQueue, names: Mapping[str, str], missing: int, trainings: Sequence[TrainingProgress] = ()
) -> Iterator[str]:
    """Yield why workers are idle, why jobs failed, and what trainers wait for.

    `names` are those of the store's scenes, by their ids, and `missing` samples are planned and not committed.
    """
    if isinstance(queue, StoreQueue):
        yield from idle(queue.status, names)
        yield from map(failed, queue.causes)
        if missing and not queue.status.workers:
            yield f"{missing} samples wait for a worker: none is alive; `photonfarm work` starts one"
    for training in trainings:
        if training.phase == WAITS:
            yield f"{training.run}: the trainer {WAITS}" + ("" if missing else ", and all that are planned are there")


def idle(found: QueueStatus, names: Mapping[str, str]) -> Iterator[str]:
    """Yield why scenes are not rendered, by the workers' reports, which strangers may have written."""
    for scene_id, reasons in found.idle_reports.left.items():
        if scene_id in names:
            reason = next(iter(reasons.values()))
            yield f"{names[scene_id]}: left by {len(reasons)} of {found.workers} workers: {reason}"
    paused: dict[str, list[str]] = {}
    for worker, reason in found.idle_reports.paused.items():
        paused.setdefault(reason, []).append(worker)
    for reason, workers in list(paused.items())[:IDLE_SHOWN]:
        who = f"worker {workers[0]} takes" if len(workers) == 1 else f"{len(workers)} workers take"
        yield f"{who} no jobs: {reason}"
    if len(paused) > IDLE_SHOWN:
        yield f"and {len(paused) - IDLE_SHOWN} reasons more"


def failed(cause: FailureCause) -> str:
    """How many jobs failed, and why."""
    aside = f", {cause.set_aside} of them set aside until `photonfarm submit --retry`" if cause.set_aside else ""
    return f"{len(cause.jobs)} job{'s' * (len(cause.jobs) != 1)} failed{aside}: {cause.cause}"
