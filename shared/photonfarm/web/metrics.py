"""A farm as metrics for Prometheus: what `status` shows, as numbers.

Counters are what the store and the logs of runs hold, so that they go on where another process serves them. A repair
takes samples back; Prometheus then believes that a counter has begun anew.

Labels take few values, whatever the messages of failures are: scenes are those of the store, runs those that the user
names, and failures are grouped by the class of their error.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any, get_args

from prometheus_client import generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from photonfarm.farm.progress import FarmProgress, QueueProgress, WaitKind
from photonfarm.farm.training import TRAINS, WAITS, TrainingProgress

MOST_ERRORS = 10
"""The most classes of errors that failures are told apart by; the others are `OTHER`."""

OTHER = "other"

_ERROR = re.compile(r"([A-Za-z_]\w{0,59}): ", re.ASCII)
"""The class of an error at the beginning of a failure's cause."""

STATES = ("trains", "waits", "works", "ended", "absent")
"""The states of a trainer: at its steps, without samples, at something else, at its end, or not there."""

Labels = tuple[str, ...]
Row = tuple[str, str, str, dict[Any, Any]]
"""A metric: its name, that of a counter with `_total`, the names of its labels, its help text, and values by labels."""


class FarmMetrics(Collector):
    """The metrics of a farm, made when they are asked for."""

    def __init__(self, look: Callable[[], FarmProgress]) -> None:
        """Take the function that gives the farm; who asks often should get the same one for some seconds."""
        self._look = look

    def answer(self) -> tuple[str, bytes]:
        """The type of Prometheus's text format, and the metrics in it. Raises StoreError if the store is gone."""
        return CONTENT_TYPE_PLAIN_0_0_4, generate_latest(self)

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of the farm as it is now."""
        farm = self._look()
        rows = (*_measure_store(farm), *_measure_queue(farm.queue), *_measure_trainings(farm))
        for name, labels, about, values in rows:
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            family = kind(f"photonfarm_{name}", about, labels=labels.split())
            for of, value in values.items():
                family.add_metric(of, value)
            yield family


def _measure_store(farm: FarmProgress) -> Iterator[Row]:
    readable = [scene for scene in farm.scenes if not scene.status.error]
    by_scene = {(_escape_text(scene.status.name), scene.status.scene_id): scene for scene in readable}
    by_pass = {(*of, "first"): scene.samples for of, scene in by_scene.items()}
    by_pass |= {(*of, "further"): scene.passes for of, scene in by_scene.items()}
    yield "look_timestamp_seconds", "", "When the farm was looked at, in seconds since 1970.", {(): farm.at_s}
    yield "scenes_unreadable", "", "Scenes that cannot be read.", {(): len(farm.scenes) - len(readable)}
    labels, committed, planned = "scene scene_id pass", "Committed samples.", "Planned samples."
    yield "samples_committed_total", labels, committed, {of: counts[0] for of, counts in by_pass.items()}
    yield "samples_planned", labels, planned, {of: counts[1] for of, counts in by_pass.items()}
    waits: Counter[Labels] = Counter({(kind,): 0 for kind in get_args(WaitKind)})
    for wait in farm.waits:
        waits[wait.kind,] += wait.count
    yield "waits", "kind", "What waits: scenes, workers, failed jobs, samples, trainers.", waits
    in_hand = "Samples that are rendered, in jobs that are not committed yet."
    yield "samples_in_hand", "scene scene_id", in_hand, {of: scene.in_hand for of, scene in by_scene.items()}
    for name, key, about in (
        ("jobs_committed_total", "jobs_committed", "Committed render jobs."),
        ("jobs_planned", "jobs_planned", "Planned render jobs."),
        ("committed_bytes_total", "size_bytes", "Bytes of committed jobs."),
        ("render_core_seconds_total", "core_s", "Processor time that committed jobs took."),
    ):
        yield name, "scene scene_id", about, {of: getattr(scene.status, key) for of, scene in by_scene.items()}


def _measure_queue(queue: QueueProgress) -> Iterator[Row]:
    yield "queue_up", "", "Whether the queue's Redis answers, 1 or 0.", {(): int(queue.status is not None)}
    about = "Failed jobs by the class of their error: set aside until a retry, or kept by the store alone."
    yield "failed_jobs", "error state", about, _count_failures(queue)
    if (status := queue.status) is None:
        return
    failed = sum(len(cause.jobs) for cause in queue.causes)
    jobs = {("waiting",): status.queued, ("started",): status.running, ("failed",): failed}
    yield "queue_jobs", "state", "Jobs of the queue by state.", jobs
    paused = status.paused.keys()
    rendering = len(status.activities.keys() - paused)
    idle = max(status.workers - rendering - len(paused), 0)
    workers = {("rendering",): rendering, ("paused",): len(paused), ("idle",): idle}
    yield "workers", "state", "Live workers: with a job, taking none, or without one.", workers


def _count_failures(queue: QueueProgress) -> Counter[Labels]:
    """The numbers of failed jobs by error and state; few errors, each the class before a cause's first colon."""
    counts: Counter[Labels] = Counter()
    by_error: Counter[str] = Counter()
    for state, causes in (("failed", queue.causes), ("kept", queue.kept)):
        for cause in causes:
            error = match[1] if (match := _ERROR.match(cause.cause)) else OTHER
            counts[error, state] += len(cause.jobs)
            by_error[error] += len(cause.jobs)
    told = {error for error, _ in by_error.most_common(MOST_ERRORS)}
    grouped: Counter[Labels] = Counter()
    for (error, state), count in counts.items():
        grouped[error if error in told else OTHER, state] += count
    return grouped


def _measure_trainings(farm: FarmProgress) -> Iterator[Row]:
    runs: dict[Labels, TrainingProgress] = {}
    for training in farm.trainings:
        name, number = _escape_text(training.run), 1
        while (label := name if number == 1 else f"{name} {number}",) in runs:  # several folders may be called so
            number += 1
        runs[label,] = training
    numbers = {
        of: {**asdict(run), **(run.validation or {}), "step": run.step, "steps": run.steps or None}
        for of, run in runs.items()
    }
    for name, key, about in (
        ("trainer_step", "step", "The step that training is at."),
        ("trainer_steps_planned", "steps", "The steps after which training ends."),
        ("trainer_loss", "loss", "The training loss that was logged last."),
        ("trainer_heldout_error", "error", "The held-out error of the last validation."),
        ("trainer_heldout_standard_error", "standard_error", "The standard error of the held-out error."),
        (
            "trainer_heldout_samples",
            "held_out",
            "The samples that the last validation was on, one of each held-out view.",
        ),
    ):
        yield name, "run", about, {of: figures[key] for of, figures in numbers.items() if _is_number(figures.get(key))}
    spent = {
        (*of, _escape_text(activity)): seconds
        for of, training in runs.items()
        for activity, seconds in training.seconds.items()
        if _is_number(seconds)
    }
    yield "trainer_seconds_total", "run activity", "Seconds of training so far, by what they were spent on.", spent
    about = "1 for the state that the trainer is in, 0 for the others."
    states = {(*of, state): float(state == _name_state(run)) for of, run in runs.items() for state in STATES}
    yield "trainer_state", "run state", about, states


def _name_state(training: TrainingProgress) -> str:
    if training.phase is None:
        return "ended" if training.ended else "absent"
    return {TRAINS: "trains", WAITS: "waits"}.get(training.phase, "works")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _escape_text(name: str) -> str:
    """A name as UTF-8 holds it: names of folders may be other bytes."""
    return name.encode(errors="replace").decode()
