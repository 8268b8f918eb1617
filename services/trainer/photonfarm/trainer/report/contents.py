"""The contents of a report, gathered once for its page, its Markdown and its JSON.

The published tables stand beside ours [supplement 4, Tables 1 and 2]. They are of four rooms at 256², on the authors'
GPU: values cannot be compared with ours, but orders of errors can, and ratios of networks' times. Denoisers' times are
mostly rendering, of as many samples per pixel as the authors chose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Unpack

from photonfarm.core.archives import FrameCosts
from photonfarm.core.errors import BackendError
from photonfarm.core.records import F32, Guides, ViewBuffers
from photonfarm.core.statistics import Estimate
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader
from photonfarm.trainer.compare.evaluate import Evaluation, MeasureOptions, PredictorRow, compare
from photonfarm.trainer.compare.evaluation_samples import Reference
from photonfarm.trainer.predictors.evaluation import Predictor
from photonfarm.trainer.predictors.trained import TrainedRun, list_predictors
from photonfarm.trainer.report.data_and_runs import (
    Baselines,
    DatasetCard,
    RunStory,
    make_baselines,
    name_given,
    shorten_names,
)
from photonfarm.trainer.report.frame_times import (
    FrameTime,
    Machine,
    assemble_frame_time,
    count_points,
    measure_frame_costs,
)
from photonfarm.trainer.report.worst_cases import HeldOutView, WorstCase, find_worst_cases


@dataclass(frozen=True, slots=True)
class Published:
    """A row of a published table."""

    seconds: float  # per frame
    mse: float
    mssim: float
    fid: float
    feature_l1: float


FIXED_LIGHTS = {
    "denoise_1": Published(1.5059, 0.0005, 0.880, 26.4, 0.163),
    "denoise_4": Published(0.3800, 0.0007, 0.867, 28.1, 0.172),
    "denoise_16": Published(0.0986, 0.0012, 0.835, 38.7, 0.203),
    "denoise_32": Published(0.0532, 0.0018, 0.813, 54.1, 0.233),
    "denoise_64": Published(0.0283, 0.0029, 0.781, 94.0, 0.281),
    "cnn": Published(0.0191, 0.0043, 0.835, 36.1, 0.195),
    "feature_projection": Published(0.0210, 0.0037, 0.841, 32.5, 0.185),
    "light_transport": Published(0.0243, 0.0044, 0.841, 31.4, 0.184),
    "light_transport_photons": Published(0.0459, 0.0028, 0.849, 30.6, 0.182),
}
MOVABLE_LIGHTS = {
    "denoise_1": Published(1.5059, 0.0002, 0.930, 17.1, 0.137),
    "denoise_4": Published(0.3801, 0.0002, 0.923, 17.6, 0.143),
    "denoise_16": Published(0.0988, 0.0005, 0.896, 23.5, 0.172),
    "denoise_32": Published(0.0518, 0.0008, 0.874, 38.6, 0.207),
    "denoise_64": Published(0.0283, 0.0016, 0.839, 84.1, 0.269),
    "cnn": Published(0.0190, 0.0100, 0.827, 33.7, 0.199),
    "feature_projection": Published(0.0208, 0.0098, 0.827, 32.9, 0.197),
    "light_transport": Published(0.0243, 0.0029, 0.871, 30.0, 0.184),
    "light_transport_photons": Published(0.0468, 0.0014, 0.887, 25.1, 0.172),
}

Inputs = tuple[ViewBuffers, Guides | None]
"""What a network is given of a view."""

PublishedTable = dict[str, Published]
"""Rows by architecture, in the order of the published table."""


def find_published_table(spec: SceneSpec) -> tuple[str | None, PublishedTable]:
    """The name of the published table for scenes of this kind, and its rows; of a static scene there is none."""
    if spec.lights:
        return "Table 2, movable objects and lights", MOVABLE_LIGHTS
    return ("Table 1, movable objects and fixed lights", FIXED_LIGHTS) if spec.objects else (None, {})


@dataclass(frozen=True, slots=True, eq=False)
class ReportEntry:
    """A row of the report's tables."""

    name: str
    architecture: str | None  # of a network; None for a ready denoiser
    row: PredictorRow
    time: FrameTime | None  # None if the renderer is not installed
    published: Published | None  # the paper's row of the same architecture

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Its metrics against references, by name, as far as they are available."""
        return {} if self.row.metrics is None else self.row.metrics.estimates()


@dataclass(frozen=True, slots=True, eq=False)
class ReportContents:
    """A report: the data, the runs, the errors of their networks, and the worst cases of the first one."""

    card: DatasetCard
    stories: tuple[RunStory, ...]
    baselines: Baselines
    evaluation: Evaluation
    entries: tuple[ReportEntry, ...]
    costs: FrameCosts | None
    untimed: str  # why there are no costs
    machine: Machine  # on which times were taken
    worst: tuple[WorstCase, ...]
    published: str | None  # the name of the paper's table beside ours
    inputs: Mapping[int, Inputs]  # of the shown rows, as far as the first run is given them

    @property
    def measure(self) -> ReportEntry:
        """The entry that ratios of times refer to: light_transport, or else the first."""
        return next((entry for entry in self.entries if entry.architecture == "light_transport"), self.entries[0])

    def document(self) -> dict[str, Any]:
        """The figures of report.json."""
        rows = self.evaluation.document()
        for row, entry in zip(rows["rows"], self.entries, strict=True):
            row["name"], row["architecture"] = entry.name, entry.architecture
            row["frame_seconds"] = None if entry.time is None else entry.time.document()
            row["published"] = None if entry.published is None else asdict(entry.published)
        metrics = self.entries[0].row.metrics
        return {
            "val_mse_metric": None if metrics is None else metrics.mse.estimate.mean,
            "val_mssim": None if metrics is None else metrics.mssim.estimate.mean,
            "dataset": self.card.document(),
            "runs": [story.document() for story in self.stories],
            "mean_colour": self.baselines.mean_colour.error.mean,
            "given": {"what": self.baselines.than, "error": self.baselines.given.error.mean},
            "untrained": self.baselines.untrained.error.mean,
            "evaluation": rows,
            "machine": asdict(self.machine),
            "edit_seconds": None if self.costs is None else self.costs.parts()["edit_s"].median,
            "published_table": self.published,
            "worst_cases": [asdict(case) for case in self.worst],
        }


def gather_contents(
    store: str | Path, runs: Sequence[TrainedRun], *, timed: bool, **how: Unpack[MeasureOptions]
) -> ReportContents:
    """Measure everything; the times of frames only if `timed`. Raises what `compare` raises."""
    first, predictors = runs[0], list_predictors(runs, how.get("denoisers", ()), how.get("halves", ()))
    card = DatasetCard.of(store, first.scene_id, first.exposure)
    needs = [predictor.needs for predictor in predictors]
    tell = how.get("on_progress") or (lambda *_: None)
    costs: FrameCosts | None = None
    untimed, worst, machine = "it was not asked for", [], Machine.here()

    def look_closely(images: Mapping[int, F32], references: Mapping[int, Reference]) -> list[int]:
        """Time frames right after the networks, then find the worst cases of the first network; their rows."""
        nonlocal costs, untimed, worst, machine
        if timed:
            tell("the renderer times frames", 0, 0)
            try:
                costs = measure_frame_costs(store, first, list(references or images), needs, count_points(runs))
            except BackendError as error:
                untimed = str(error)
        machine = Machine.here()
        tell("the worst cases are looked for", 0, 0)
        surfaces = {} if costs is None else dict(zip(costs.rows.tolist(), costs.surface, strict=True))
        inputs = _read_inputs(store, first, sorted(references.keys() & images.keys()), guides=False)
        worst = find_worst_cases(
            [
                HeldOutView(
                    row, images[row], references[row].half_a, references[row].half_b, buffers, surfaces.get(row)
                )
                for row, (buffers, _) in inputs.items()
            ]
        )
        return [case.row for case in worst]

    def make_beside(source: SceneReader) -> list[Predictor]:
        return make_baselines(source, first, how.get("device", "auto"), tell)

    evaluation = compare(store, runs, choose=look_closely, beside=make_beside, **how)
    title, table = find_published_table(card.spec)
    names = shorten_names(list(runs))
    by_folder = {run.folder: name for run, name in zip(runs, names, strict=True)}
    entries = []
    for predictor, row in zip(predictors, evaluation.rows, strict=True):
        name, architecture = row.name, None
        if isinstance(predictor, TrainedRun):
            name, architecture = by_folder[predictor.folder], predictor.settings.network.architecture
            name = predictor.name_halves(name)
        time = None if costs is None else assemble_frame_time(predictor, row.seconds, costs)
        entries.append(ReportEntry(name, architecture, row, time, table.get(architecture or "")))
    return ReportContents(
        card=card,
        stories=tuple(RunStory.of(name, run, card.samples.core_seconds) for name, run in zip(names, runs, strict=True)),
        baselines=Baselines(name_given(first), *evaluation.beside),
        evaluation=evaluation,
        entries=tuple(entries),
        costs=costs,
        untimed=untimed,
        machine=machine,
        worst=tuple(worst),
        published=title if any(entry.published for entry in entries) else None,
        inputs=_read_inputs(store, first, [target.row for target in evaluation.shown], guides=first.needs.guides),
    )


def _read_inputs(store: str | Path, run: TrainedRun, rows: list[int], *, guides: bool) -> dict[int, Inputs]:
    source = run.source(store)
    source.refresh()
    samples = (source.read(row, guides=guides) for row in rows)  # one by one: their radiance is not kept
    return {sample.row: (sample.buffers, sample.guides) for sample in samples}
