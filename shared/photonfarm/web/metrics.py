"""A farm as metrics for Prometheus: what `status --watch` shows, as numbers.

Counters are what the store and the logs of runs hold, so that they go on where another process serves them. A repair
takes samples back; Prometheus then believes that a counter has begun anew.

Labels take few values, whatever the messages of failures are: scenes are those of the store, runs those that the user
names, and failures are grouped by the class of their error.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_args

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from photonfarm.farm.status import NoQueue, StoreQueue, WaitKind
from photonfarm.farm.training import TRAINS, WAITS, TrainingProgress
from photonfarm.farm.watch import FarmView, SceneView
from photonfarm.web.server import Answer

MOST_ERRORS = 10
"""The most classes of errors that failures are told apart by; the others are `OTHER`."""

OTHER = "other"

_ERROR = re.compile(r"([A-Za-z_]\w{0,59}): ", re.ASCII)
"""The class of an error at the beginning of a failure's cause."""

STATES = ("trains", "waits", "works", "ended", "absent")
"""The states of a trainer: at its steps, without samples, at something else, at its end, or not there."""

Labels = tuple[str, ...]


class FarmMetrics(Collector):
    """The metrics of a farm, made when they are asked for."""

    def __init__(self, look: Callable[[], FarmView]) -> None:
        """Take the function that gives the farm; who asks often should get the same view for some seconds."""
        self._look = look
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def answer(self) -> Answer:
        """The metrics in Prometheus's text format. Raises StoreError if the store is gone."""
        return CONTENT_TYPE_PLAIN_0_0_4, generate_latest(self._registry)

    def describe(self) -> Sequence[Metric]:
        """Nothing: names are known without a look at the farm, as no other collector is in the registry."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of the farm as it is now."""
        view = self._look()
        yield _make_gauge(
            "look_timestamp_seconds", "When the farm was looked at, in seconds since 1970.", {(): view.at_s}
        )
        yield from _measure_scenes([scene for scene in view.scenes if not scene.error])
        unreadable = sum(bool(scene.error) for scene in view.scenes)
        yield _make_gauge("scenes_unreadable", "Scenes of the store that cannot be read.", {(): unreadable})
        yield from _measure_queue(view.queue)
        yield from _measure_trainings(_name_runs(view.trainings))
        waits = Counter({(kind,): 0 for kind in get_args(WaitKind)})
        for wait in view.waits:
            waits[(wait.kind,)] += wait.count
        yield _make_gauge("waits", "What waits: scenes, workers, failed jobs, samples, trainers.", waits, "kind")


def _measure_scenes(scenes: Sequence[SceneView]) -> Iterator[Metric]:
    names = "scene", "scene_id"
    of = {(_escape_text(scene.name), scene.scene_id): scene for scene in scenes}
    by_pass = [
        ((*labels, which), counts)
        for labels, scene in of.items()
        for which, counts in (("first", scene.samples), ("further", scene.passes))
    ]
    yield _make_counter(
        "samples_committed",
        "Committed samples: first passes of views, and further ones.",
        {labels: counts[0] for labels, counts in by_pass},
        *names,
        "pass",
    )
    yield _make_gauge(
        "samples_planned",
        "Planned samples: first passes of views, and further ones.",
        {labels: counts[1] for labels, counts in by_pass},
        *names,
        "pass",
    )
    yield _make_gauge(
        "samples_in_hand",
        "Samples that are rendered, in jobs that are not committed yet.",
        {labels: scene.in_hand for labels, scene in of.items()},
        *names,
    )
    committed = {labels: scene.jobs[0] for labels, scene in of.items()}
    yield _make_counter("jobs_committed", "Committed render jobs.", committed, *names)
    planned = {labels: scene.jobs[1] for labels, scene in of.items()}
    yield _make_gauge("jobs_planned", "Planned render jobs.", planned, *names)
    sizes = {labels: scene.size_bytes for labels, scene in of.items()}
    yield _make_counter("committed_bytes", "Bytes of committed jobs.", sizes, *names)
    core_s = {labels: scene.core_s for labels, scene in of.items()}
    yield _make_counter("render_core_seconds", "Processor time that committed jobs took.", core_s, *names)


def _measure_queue(queue: StoreQueue | NoQueue) -> Iterator[Metric]:
    yield _make_gauge(
        "queue_up", "Whether the queue's Redis answers, 1 or 0.", {(): int(isinstance(queue, StoreQueue))}
    )
    failed = _count_failures(queue)
    yield _make_gauge(
        "failed_jobs",
        "Failed jobs by the class of their error: set aside until a retry, or kept by the store alone.",
        failed,
        "error",
        "state",
    )
    if isinstance(queue, NoQueue):
        return
    status = queue.status
    jobs: dict[Labels, float] = {("waiting",): status.queued, ("started",): status.running}
    jobs[("failed",)] = sum(count for (_, state), count in failed.items() if state == "failed")
    yield _make_gauge("queue_jobs", "Jobs of the queue by state.", jobs, "state")
    paused = status.paused.keys()
    rendering = len(status.activities.keys() - paused)
    idle = max(status.workers - rendering - len(paused), 0)
    workers: dict[Labels, float] = {("rendering",): rendering, ("paused",): len(paused), ("idle",): idle}
    yield _make_gauge("workers", "Live workers: with a job, taking none, or without one.", workers, "state")


def _count_failures(queue: StoreQueue | NoQueue) -> dict[Labels, int]:
    """The numbers of failed jobs by error and state; few errors, each the class before a cause's first colon."""
    counts: Counter[Labels] = Counter()
    for cause in () if isinstance(queue, NoQueue) else queue.causes:
        counts[_name_error(cause.cause), "failed"] += len(cause.jobs)
    for cause in queue.kept:
        counts[_name_error(cause.cause), "kept"] += len(cause.jobs)
    by_error: Counter[str] = Counter()
    for (error, _), count in counts.items():
        by_error[error] += count
    told = {error for error, _ in by_error.most_common(MOST_ERRORS)}
    grouped: Counter[Labels] = Counter()
    for (error, state), count in counts.items():
        grouped[error if error in told else OTHER, state] += count
    return dict(grouped)


def _name_error(cause: str) -> str:
    """The class of an error, by a failure's cause."""
    match = _ERROR.match(cause)
    return match[1] if match else OTHER


def _measure_trainings(of: dict[Labels, TrainingProgress]) -> Iterator[Metric]:
    steps = {run: each.step for run, each in of.items()}
    yield _make_gauge("trainer_step", "The step that training is at.", steps, "run")
    planned = {run: each.steps for run, each in of.items() if each.steps}
    yield _make_gauge("trainer_steps_planned", "The steps after which training ends.", planned, "run")
    losses = {run: each.loss for run, each in of.items() if each.loss is not None}
    yield _make_gauge("trainer_loss", "The training loss that was logged last.", losses, "run")
    for name, key, about in (
        ("error", "error", "The held-out error of the last validation."),
        ("standard_error", "standard_error", "The standard error of the held-out error."),
        ("samples", "held_out", "The samples that the last validation was on."),
    ):
        values = {run: each.validation.get(key) for run, each in of.items() if each.validation is not None}
        numbers = {run: value for run, value in values.items() if isinstance(value, int | float)}
        yield _make_gauge(f"trainer_heldout_{name}", about, numbers, "run")
    spent = {
        (*run, _escape_text(activity)): seconds
        for run, each in of.items()
        for activity, seconds in each.seconds.items()
        if isinstance(seconds, int | float) and math.isfinite(seconds)
    }
    yield _make_counter(
        "trainer_seconds", "Seconds of training so far, by what they were spent on.", spent, "run", "activity"
    )
    states = {(*run, state): float(state == _number_state(each)) for run, each in of.items() for state in STATES}
    yield _make_gauge(
        "trainer_state", "1 for the state that the trainer is in, 0 for the others.", states, "run", "state"
    )


def _number_state(training: TrainingProgress) -> str:
    if training.phase is None:
        return "ended" if training.ended else "absent"
    return {TRAINS: "trains", WAITS: "waits"}.get(training.phase, "works")


def _name_runs(trainings: Sequence[TrainingProgress]) -> dict[Labels, TrainingProgress]:
    """Runs by a label each: the name of the folder, with a number behind it where several are called so."""
    by_labels: dict[Labels, TrainingProgress] = {}
    for training in trainings:
        name, number = _escape_text(training.run), 1
        while (label := name if number == 1 else f"{name} {number}",) in by_labels:
            number += 1
        by_labels[label,] = training
    return by_labels


def _escape_text(name: str) -> str:
    """A name as UTF-8 holds it: names of folders may be other bytes."""
    return name.encode(errors="replace").decode()


def _make_gauge(name: str, about: str, values: dict[Any, Any], *labels: str) -> Metric:
    return _fill(GaugeMetricFamily(f"photonfarm_{name}", about, labels=labels), values)


def _make_counter(name: str, about: str, values: dict[Any, Any], *labels: str) -> Metric:
    return _fill(CounterMetricFamily(f"photonfarm_{name}", about, labels=labels), values)


def _fill(family: GaugeMetricFamily | CounterMetricFamily, values: dict[Any, Any]) -> Metric:
    for labels, value in values.items():
        family.add_metric(labels, value)
    return family
