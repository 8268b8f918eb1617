"""`photonfarm evaluate`: the error of trained networks, and of denoisers not trained on the scene, on held-out samples.

There are two errors, for different questions. In linear radiance noisy halves are enough: their noise is taken out
exactly. The columns of the paper's tables concern what a display shows, and need converged references [supplement 4].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch

from photonfarm.core.archives import Seconds
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.store import SceneReader
from photonfarm.trainer.compare.evaluation_samples import HeldOutSamples, Reference, References, Target, read_references
from photonfarm.trainer.data.batch import TrainingBatch, count_kept
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.metrics.features import Features, Inception, load_inception
from photonfarm.trainer.metrics.image_metrics import ImageMetrics, confidence_interval, measure_images, metric_space
from photonfarm.trainer.networks.inputs import Inputs
from photonfarm.trainer.predictors.evaluation import (
    NONE_COMPLETE,
    DevicePredictor,
    HeldOutErrors,
    Predictor,
    measure,
    read_batches,
    time_by_turns,
)
from photonfarm.trainer.predictors.trained import ReadyPredictor, TrainedRun, list_predictors
from photonfarm.trainer.runs.devices import describe_device, usable_device
from photonfarm.trainer.runs.settings import MOST_HELD_OUT, ReadyDenoiser

Choose = Callable[[Mapping[int, F32], Mapping[int, Reference]], Sequence[int]]
"""A function that names rows to show beside the first ones.

It gets the first predictor's images (H, W, 3), and the references that some rows have.
"""

MeasureProgress = Callable[[str, int, int], object]
"""A callback with a predictor's name, the number of samples it was measured on so far, and of all samples.

Other parts of the work are told by their name, 0 and 0.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PredictorRow:
    """One predictor's results on the held-out samples."""

    name: str
    kept: int | None  # it gets one of so many pixels of half A; None: no colour
    held_out: HeldOutErrors  # linear radiance × exposure, noise removed
    seconds: Seconds  # of its network alone, for one image
    metrics: ImageMetrics | None  # in the metric space; None if no view has a reference
    shown: Mapping[int, F32]  # its images, (H, W, 3), of the rows that are shown

    def behind(self, first: PredictorRow) -> Estimate | None:
        """The excess of its linear error over another's, in pairs of configurations; None for other samples."""
        if self.held_out.units != first.held_out.units:
            return None
        difference = self.held_out.per_sample - first.held_out.per_sample
        return Estimate.of(group_means(difference, self.held_out.units))

    def document(self, first: PredictorRow) -> dict[str, Any]:
        """Its part of evaluation.json, with its excess over the first row."""
        error, behind = self.held_out.error, self.behind(first)
        return {
            "predictor": self.name,
            "network_seconds": self.seconds.median,
            "network_seconds_range": [self.seconds.low, self.seconds.high],
            "linear_mse": {
                "mean": error.mean,
                "standard_error": error.standard_error,
                "interval_95": confidence_interval(error),
                "count": error.count,
                "per_sample": self.held_out.per_sample.tolist(),
            },
            "behind_first": None if behind is None else {**asdict(behind), "interval_95": confidence_interval(behind)},
            "metric_space": None if self.metrics is None else asdict(self.metrics),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Several predictors' results on the same samples."""

    scene: str
    scene_id: str
    unit: str  # the independent unit: "configuration" or, in a static scene, "view"
    measured: tuple[int, ...]  # rows of the store, one of each view; without those that are complete no longer
    device: str  # of the networks
    threads: int  # of torch on the CPU
    references: References | None
    rows: tuple[PredictorRow, ...]
    shown: tuple[Target, ...]

    @property
    def samples(self) -> int:
        """The number of samples that all were measured on, each of a view of its own."""
        return len(self.measured)

    @property
    def noise_floor(self) -> float:
        """The noise of the targets, which would be added to a linear error against them."""
        return self.rows[0].held_out.floor

    @property
    def units(self) -> int:
        """The number of configurations (in a static scene, of views) of the samples."""
        return self.rows[0].held_out.error.count

    def document(self) -> dict[str, Any]:
        """The content of evaluation.json."""
        return {
            "scene": self.scene,
            "scene_id": self.scene_id,
            "samples": self.samples,
            "views": self.samples,
            "unit": self.unit,
            "units": self.units,
            "noise_floor": self.noise_floor,
            "device": self.device,
            "threads": self.threads,
            "references": None if self.references is None else asdict(self.references),
            "rows": [row.document(self.rows[0]) for row in self.rows],
            "shown": [target.row for target in self.shown],  # of the store: the rows of comparison.png, from the top
        }


class MeasureOptions(TypedDict, total=False):
    """The options of `compare` that reports have too."""

    denoisers: Sequence[tuple[ReadyDenoiser, int]]
    references: Path | None
    inception: Path | None
    most: int
    device: str
    on_progress: MeasureProgress | None


def compare(
    store: str | Path,
    runs: Sequence[TrainedRun],
    denoisers: Sequence[tuple[ReadyDenoiser, int]] = (),
    *,
    references: Path | None = None,
    inception: Path | None = None,
    without_inception: bool = False,
    most: int = MOST_HELD_OUT,
    device: str = "auto",
    on_progress: MeasureProgress | None = None,
    choose: Choose | None = None,
) -> Evaluation:
    """Compare runs, and denoisers given one of so many pixels, on the first `most` views that no run was trained on.

    Each view is measured once, by its first sample, however many passes of it there are. References are files
    `<view key>.npz` as `photonfarm store merge` writes them; views without one are left out of the metric space.
    FID, KID and Feature L1 take most of the time; `without_inception` leaves them out. Raises SpecError for runs of
    different scenes, for references of another size, for a film with too few pixels to keep some, and for a package
    that is missing; IncompleteError if no held-out sample is complete.
    """
    first, place = runs[0], usable_device(device)
    _check_same_scene(runs)
    torch.set_num_threads(first.settings.threads)
    samples = HeldOutSamples.of(first.source(store), min(run.settings.hold_out for run in runs), most)
    spec = samples.source.spec
    for _, kept in denoisers:
        count_kept(spec, kept)
    references_by_row = {} if references is None else read_references(references, samples)
    shown = samples.to_show(references_by_row)
    network = load_inception(inception, str(place)) if references_by_row and not without_inception else None
    test = _Test(store, samples, references_by_row, network, str(place), on_progress or (lambda *_: None))
    predictors = list_predictors(runs, denoisers)
    test.on_progress("networks are loaded and timed", 0, 0)
    calls = [test.load(predictor) for predictor in predictors]
    times, predicts = time_by_turns(calls), [predict for predict, _ in calls]
    del calls  # with the inputs on the device
    rows: list[PredictorRow] = []
    for predictor, predict, seconds in zip(predictors, predicts, times, strict=True):
        held_out, metrics, images = test.measure(predictor, predict, {*references_by_row, *shown})
        if choose and not rows:
            shown += [row for row in dict.fromkeys(choose(images, references_by_row)) if row not in shown]
        kept_images = {row: images[row] for row in shown if row in images}
        rows.append(PredictorRow(predictor.name, predictor.needs.kept, held_out, seconds, metrics, kept_images))
    return Evaluation(
        scene=spec.name,
        scene_id=first.scene_id,
        unit="configuration" if spec.groups else "view",
        measured=tuple(samples.rows),
        device=describe_device(place),
        threads=first.settings.threads,
        references=References.of(references_by_row, spec.transport.half_spp),
        rows=tuple(rows),
        shown=tuple(samples.target(row, references_by_row.get(row)) for row in shown),
    )


def _check_same_scene(runs: Sequence[TrainedRun]) -> None:
    first = runs[0]
    for key in ("scene_id", "exposure"):
        for run in runs:
            if getattr(run, key) != getattr(first, key):
                raise SpecError(
                    f"{run.folder}: was trained with {key} {getattr(run, key)}, and {first.folder} with "
                    f"{getattr(first, key)}; runs of one scene and exposure can be compared"
                )


@dataclass(frozen=True, slots=True, eq=False)
class _Test:
    """The samples, references and metrics that all predictors are measured with."""

    store: str | Path
    samples: HeldOutSamples
    references: Mapping[int, Reference]  # by row
    inception: Inception | None
    device: str
    on_progress: MeasureProgress
    known: dict[tuple[int, ...], Features] = field(default_factory=dict)  # features of references, by their rows

    def load(self, predictor: TrainedRun | ReadyPredictor) -> tuple[DevicePredictor, Inputs]:
        """Load a predictor, and the inputs of the first sample, on which it is timed."""
        with self._feed(predictor, batch=1) as feed:
            predict = predictor.predictor(feed.spec, feed.base, self.device)
            for batch in read_batches(feed, self.samples.rows, 1):
                return predict, predict.of_its_own(batch.inputs)
        raise IncompleteError(NONE_COMPLETE)

    def measure(
        self, predictor: TrainedRun | ReadyPredictor, predict: Predictor, kept: set[int]
    ) -> tuple[HeldOutErrors, ImageMetrics | None, dict[int, F32]]:
        """Measure a predictor on all samples; also returns its images of the `kept` rows."""
        rows, size = self.samples.rows, predictor.settings.batch
        images: dict[int, F32] = {}
        units: dict[int, Key] = {}
        done = 0

        def watch(batch: TrainingBatch) -> F32:
            nonlocal done
            predicted = predict(batch)
            for row, unit, image in zip(batch.rows, batch.units, predicted, strict=True):
                if row in kept:
                    images[row], units[row] = image.copy(), unit
            done += len(batch.rows)
            self.on_progress(predictor.name, done, len(rows))
            return predicted

        with self._feed(predictor, batch=size) as feed:
            held_out = measure(watch, read_batches(feed, rows, size))
        if self.references:
            self.on_progress(f"{predictor.name} is compared with the references", 0, 0)
        compared = [row for row in images if row in self.references]
        if not compared:
            return held_out, None, images
        a, b, mean = (
            np.stack([getattr(self.references[row], image) for row in compared])
            for image in ("half_a", "half_b", "mean")
        )
        metrics = measure_images(
            np.stack([images[row] for row in compared]),
            mean,
            self.inception,
            [units[row] for row in compared],
            (a, b),
            having_seen_a=predictor.needs.kept is not None,
            wanted_features=self._features(tuple(compared), mean),
        )
        return held_out, metrics, images

    def _feed(self, predictor: TrainedRun | ReadyPredictor, *, batch: int) -> Feed:
        settings = predictor.settings.model_copy(update={"device": self.device, "batch": batch})
        spec = self.samples.source.spec
        source = SceneReader(self.store, spec.scene_id, exposure=spec.exposure)
        return Feed(source, settings, needs=predictor.needs)

    def _features(self, rows: tuple[int, ...], references: F32) -> Features | None:
        """The features of the references of some rows, which are the same for almost all predictors."""
        if self.inception and rows not in self.known:
            self.known[rows] = self.inception.features(metric_space(references))
        return self.known.get(rows)
