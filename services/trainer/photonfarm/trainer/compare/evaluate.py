"""`photonfarm evaluate`: the error of trained networks, and of denoisers not trained on the scene, on held-out samples.

There are two errors, for different questions. In linear radiance noisy halves are enough: their noise is taken out
exactly. The columns of the paper's tables concern what a display shows, and need converged references [supplement 4].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from photonfarm.trainer.metrics.features import Features, Inception, load_inception
from photonfarm.trainer.metrics.image_metrics import ImageMetrics, confidence_interval, measure_images, metric_space
from photonfarm.trainer.networks.inputs import Inputs
from photonfarm.trainer.predictors.evaluation import (
    DevicePredictor,
    HeldOutErrors,
    Predictor,
    measure_together,
    read_in_turn,
    time_by_turns,
)
from photonfarm.trainer.predictors.trained import ReadyChoice, ReadyPredictor, TrainedRun, list_predictors
from photonfarm.trainer.runs.devices import describe_device, usable_device
from photonfarm.trainer.runs.settings import MOST_HELD_OUT

Choose = Callable[[Mapping[int, F32], Mapping[int, Reference]], Sequence[int]]
"""A function that names rows to show beside the first ones.

It gets the first predictor's images (H, W, 3), and the references that some rows have.
"""

MeasureProgress = Callable[[str, int, int], object]
"""A callback with the names of predictors, the number of samples they were measured on so far, and of all samples.

Other parts of the work are told by their name, 0 and 0.
"""


AnyPredictor = TrainedRun | ReadyPredictor


@dataclass(frozen=True, slots=True, eq=False)
class PredictorRow:
    """One predictor's results on the held-out samples."""

    name: str
    kept: int | None  # it gets one of so many pixels of half A; None: no colour
    halves: int  # or of the mean of so many; of more than one, no image is shown
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
            "halves": self.halves,
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
    has_inception: bool = True  # FID, KID and Feature L1 were asked for
    beside: tuple[HeldOutErrors, ...] = ()  # of the predictors that were measured beside the first one

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

    denoisers: Sequence[ReadyChoice]
    halves: Sequence[int]
    references: Path | None
    inception: Path | None
    without_inception: bool
    most: int
    device: str
    on_progress: MeasureProgress | None


def compare(
    store: str | Path,
    runs: Sequence[TrainedRun],
    denoisers: Sequence[ReadyChoice] = (),
    *,
    halves: Sequence[int] = (),
    references: Path | None = None,
    inception: Path | None = None,
    without_inception: bool = False,
    most: int = MOST_HELD_OUT,
    device: str = "auto",
    on_progress: MeasureProgress | None = None,
    choose: Choose | None = None,
    beside: Callable[[SceneReader], Sequence[Predictor]] | None = None,
) -> Evaluation:
    """Compare runs, and ready denoisers, on the first `most` views that none of their weights was trained on.

    Each view is measured once, by its first sample, however many passes of it there are. Denoisers and networks of
    halves are also given the mean of so many `halves`, of views that have so many passes, in errors alone. References
    are files `<view key>.npz` as `photonfarm store merge` writes them; views without one are left out of the metric
    space. FID, KID and Feature L1 take most of the time; `without_inception` leaves them out. What `beside` makes with
    the samples' reader is measured on what the first run reads. Raises SpecError for runs of different scenes, for
    references of another size, for a film with too few pixels to keep some, and for a package that is missing;
    IncompleteError if no held-out sample is complete.
    """
    first, place = runs[0], usable_device(device)
    _check_same_scene(runs)
    torch.set_num_threads(first.settings.threads)
    samples = HeldOutSamples.of(first.source(store), min(run.hold_out for run in runs), most)
    spec = samples.source.spec
    for _, kept in denoisers:
        count_kept(spec, kept)
    references_by_row = {} if references is None else read_references(references, samples)
    shown = samples.to_show(references_by_row)
    network = load_inception(inception, str(place)) if references_by_row and not without_inception else None
    test = _Test(samples, references_by_row, network, str(place), on_progress or (lambda *_: None))
    predictors = list_predictors(runs, denoisers, halves)
    test.on_progress("networks are loaded and timed", 0, 0)
    calls = [test.load(predictor) for predictor in predictors]
    times, predicts = time_by_turns(calls), [predict for predict, _ in calls]
    del calls  # with the inputs on the device
    rows: dict[int, PredictorRow] = {}
    errors_beside: list[HeldOutErrors] = []
    for alike in _group_alike(predictors):
        others = beside(samples.source) if beside and not rows else ()
        pairs = [(predictors[number], predicts[number]) for number in alike]
        errors, images, units = test.measure(pairs, others, {*references_by_row, *shown})
        errors_beside += errors[len(alike) :]
        if choose and not rows:
            shown += [row for row in dict.fromkeys(choose(images[0], references_by_row)) if row not in shown]
        needs = predictors[alike[0]].needs
        for number, held_out, own in zip(alike, errors, images, strict=False):
            predictor = predictors[number]
            seen = {row: own[row] for row in shown if row in own and needs.halves == 1}
            metrics = test.compare_images(predictor, own, units)
            how = (needs.kept, needs.halves, held_out, times[number], metrics, seen)
            rows[number] = PredictorRow(predictor.name, *how)
    return Evaluation(
        scene=spec.name,
        scene_id=first.scene_id,
        unit="configuration" if spec.groups else "view",
        measured=tuple(samples.rows),
        device=describe_device(place),
        threads=first.settings.threads,
        references=References.of(references_by_row, spec.transport.half_spp),
        rows=tuple(rows[number] for number in range(len(predictors))),
        has_inception=not without_inception,
        shown=tuple(samples.target(row, references_by_row.get(row)) for row in shown),
        beside=tuple(errors_beside),
    )


def _group_alike(predictors: Sequence[AnyPredictor]) -> list[list[int]]:
    """The places of predictors that read the same of each sample, in batches of one size, together."""
    groups: dict[Any, list[int]] = {}
    for place, predictor in enumerate(predictors):
        settings = predictor.settings
        groups.setdefault((predictor.needs, settings.batch, settings.network.points), []).append(place)
    return list(groups.values())


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

    samples: HeldOutSamples
    references: Mapping[int, Reference]  # by row
    inception: Inception | None
    device: str
    on_progress: MeasureProgress
    known: dict[tuple[int, ...], Features] = field(default_factory=dict)  # features of references, by their rows

    def load(self, predictor: AnyPredictor) -> tuple[DevicePredictor, Inputs]:
        """Load a predictor, and the inputs of the first sample, on which it is timed."""
        source = self.samples.source
        predict = predictor.predictor(source.spec, source.base(), self.device)
        return predict, predict.of_its_own(next(self._read(predictor, 1)).inputs)

    def measure(
        self,
        alike: Sequence[tuple[AnyPredictor, Predictor]],
        beside: Sequence[Predictor],
        keep: set[int],
    ) -> tuple[list[HeldOutErrors], list[dict[int, F32]], dict[int, Key]]:
        """Measure predictors that read the same of each sample, and further ones `beside` them, on all samples.

        Also returns the images of the `keep` rows by each of the first ones, and what each row is held out by.
        """
        (first, _), names = alike[0], ", ".join(predictor.name for predictor, _ in alike)
        images: list[dict[int, F32]] = [{} for _ in alike]
        units: dict[int, Key] = {}

        def read() -> Iterator[TrainingBatch]:
            self.on_progress(names, 0, len(self.samples.rows))
            for batch in self._read(first, first.settings.batch):
                units.update(zip(batch.rows, batch.units, strict=True))
                yield batch
                self.on_progress(names, len(units), len(self.samples.rows))

        def keeping(predict: Predictor, kept: dict[int, F32]) -> Predictor:
            def predict_and_keep(batch: TrainingBatch) -> F32:
                predicted = predict(batch)
                for row, image in zip(batch.rows, predicted, strict=True):
                    if row in keep:
                        kept[row] = image.copy()
                return predicted

            return predict_and_keep

        predicts = [keeping(predict, kept) for (_, predict), kept in zip(alike, images, strict=True)]
        return measure_together([*predicts, *beside], read()), images, units

    def compare_images(
        self, predictor: AnyPredictor, images: Mapping[int, F32], units: Mapping[int, Key]
    ) -> ImageMetrics | None:
        """Compare a predictor's images with the references; None where there are none of these rows."""
        compared = [row for row in images if row in self.references]
        if not compared:
            return None
        self.on_progress(f"{predictor.name} is compared with the references", 0, 0)
        a, b, mean = (
            np.stack([getattr(self.references[row], image) for row in compared])
            for image in ("half_a", "half_b", "mean")
        )
        return measure_images(
            np.stack([images[row] for row in compared]),
            mean,
            self.inception if predictor.needs.halves == 1 else None,
            [units[row] for row in compared],
            (a, b),
            having_seen_a=predictor.needs.kept is not None,
            wanted_features=self._features(tuple(compared), mean),
        )

    def _read(self, predictor: AnyPredictor, size: int) -> Iterator[TrainingBatch]:
        """The samples whose views have as many passes as a predictor is given. Raises IncompleteError if none has."""
        source, needs = self.samples.source, predictor.needs
        rows = [row for row in self.samples.rows if len(source.rows_of_view(source.view_row(row))) >= needs.halves]
        if not rows:
            few = f"no held-out view has {needs.halves} passes; `photonfarm top-up` adds more"
            raise IncompleteError(f"{predictor.name}: {few}")
        return read_in_turn(source, rows, size, needs, predictor.settings.network.points)

    def _features(self, rows: tuple[int, ...], references: F32) -> Features | None:
        """The features of the references of some rows, which are the same for almost all predictors."""
        if self.inception and rows not in self.known:
            self.known[rows] = self.inception.features(metric_space(references))
        return self.known.get(rows)
