"""The contents of a report, gathered once for its page, its Markdown and its JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from photonfarm.shared.core.errors import BackendError
from photonfarm.shared.core.estimate import Estimate
from photonfarm.shared.core.frame_costs import FrameCosts
from photonfarm.shared.core.records import F32, Guides, ViewBuffers
from photonfarm.trainer.compare import evaluate
from photonfarm.trainer.compare.evaluate import Evaluation, MeasureProgress, PredictorRow
from photonfarm.trainer.compare.evaluation_samples import Reference
from photonfarm.trainer.predict.ready import ReadyPredictor
from photonfarm.trainer.predict.trained import TrainedRun
from photonfarm.trainer.report.baselines import Baselines
from photonfarm.trainer.report.dataset_card import DatasetCard
from photonfarm.trainer.report.frame_times import FrameTime, frame_costs, frame_time, points_used
from photonfarm.trainer.report.machine import Machine
from photonfarm.trainer.report.published import Published, table_of
from photonfarm.trainer.report.trained_runs import RunStory, short_names
from photonfarm.trainer.report.worst_cases import HeldOutView, WorstCase, worst_cases
from photonfarm.trainer.runs.settings import MOST_HELD_OUT, ReadyDenoiser

R = TypeVar("R", ViewBuffers, Guides)


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
    inputs: Mapping[int, tuple[ViewBuffers, Guides | None]]  # of the shown rows, as far as the first run is given them

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
            "untrained": self.baselines.untrained.error.mean,
            "evaluation": rows,
            "machine": asdict(self.machine),
            "edit_seconds": None if self.costs is None else self.costs.medians()["edit_s"],
            "published_table": self.published,
            "worst_cases": [asdict(case) for case in self.worst],
        }


def gathered(
    store: str | Path,
    runs: Sequence[TrainedRun],
    denoisers: Sequence[tuple[ReadyDenoiser, int]],
    *,
    references: Path | None,
    inception: Path | None,
    most: int = MOST_HELD_OUT,
    device: str = "auto",
    on_progress: MeasureProgress | None = None,
    timed: bool = True,
) -> ReportContents:
    """Measure everything; the times of frames only if `timed`. Raises what `compare` raises."""
    first = runs[0]
    card = DatasetCard.of(store, first.scene_id, first.exposure)
    kept = [k for k in (1, *(run.needs.kept for run in runs), *(k for _, k in denoisers)) if k]
    tell = on_progress or (lambda *_: None)
    close_look = _CloseLook(store, first, kept, points_used(runs), tell, timed=timed)
    evaluation = evaluate.compare(
        store, runs, denoisers, references=references, inception=inception, most=most, device=device,
        on_progress=on_progress, choose=close_look,
    )  # fmt: skip
    tell("the mean colour and the untrained network are measured", 0, 0)
    costs = close_look.costs
    found = table_of(card.spec)
    names = short_names(list(runs))
    entries = tuple(_entries(evaluation, names, (runs, denoisers), costs, found[1] if found else {}))
    return ReportContents(
        card=card,
        stories=tuple(RunStory.of(name, run) for name, run in zip(names, runs, strict=True)),
        baselines=Baselines.of(first.source(store), first, evaluation.measured),
        evaluation=evaluation,
        entries=entries,
        costs=costs,
        untimed=close_look.untimed,
        machine=close_look.machine,
        worst=tuple(close_look.worst),
        published=found[0] if found and any(entry.published for entry in entries) else None,
        inputs=_inputs(store, first, [target.row for target in evaluation.shown]),
    )


def _inputs(store: str | Path, run: TrainedRun, rows: list[int]) -> dict[int, tuple[ViewBuffers, Guides | None]]:
    """The buffers of some rows, and their guides if the run reads these."""
    source = run.source(store)
    source.refresh()
    samples = {row: source.read(row, guides=run.needs.guides) for row in rows}
    return {row: (sample.buffers, sample.guides) for row, sample in samples.items()}


def _entries(
    evaluation: Evaluation,
    names: list[str],
    measured: tuple[Sequence[TrainedRun], Sequence[tuple[ReadyDenoiser, int]]],
    costs: FrameCosts | None,
    table: Mapping[str, Published],
) -> list[ReportEntry]:
    runs, denoisers = measured
    ready = [ReadyPredictor(denoiser, kept, runs[0].settings) for denoiser, kept in denoisers]
    predictors: list[TrainedRun | ReadyPredictor] = [*runs, *ready]
    entries = []
    for place, (predictor, row) in enumerate(zip(predictors, evaluation.rows, strict=True)):
        name, architecture = row.name, None
        if isinstance(predictor, TrainedRun):
            name, architecture = names[place], predictor.settings.network.architecture
        time = None if costs is None else frame_time(predictor, row.seconds, costs)
        entries.append(ReportEntry(name, architecture, row, time, table.get(architecture or "")))
    return entries


class _CloseLook:
    """Measures single frames once the first network has made its images: their costs, and the worst cases.

    It is called as `evaluate.Choose`, right after networks have been timed, and returns the worst cases' rows.
    """

    def __init__(
        self,
        store: str | Path,
        run: TrainedRun,
        kept: Sequence[int],
        points: int | None,
        on_progress: MeasureProgress,
        *,
        timed: bool,
    ) -> None:
        self._on_progress = on_progress
        self._store, self._run, self._kept, self._points, self._timed = store, run, kept, points, timed
        self.costs: FrameCosts | None = None
        self.untimed = "it was not asked for"
        self.worst: list[WorstCase] = []
        self.machine = Machine.here()

    def __call__(self, images: Mapping[int, F32], references: Mapping[int, Reference]) -> list[int]:
        if self._timed:
            self._on_progress("the renderer times frames", 0, 0)
            rows = list(references or images)
            try:
                self.costs = frame_costs(self._store, self._run, rows, self._kept, self._points)
            except BackendError as error:
                self.untimed = str(error)
        self._on_progress("the worst cases are looked for", 0, 0)
        self.machine = Machine.here()
        self.worst = worst_cases(self._views(images, references))
        return [case.row for case in self.worst]

    def _views(self, images: Mapping[int, F32], references: Mapping[int, Reference]) -> list[HeldOutView]:
        """The views that have references, with the first network's images of them."""
        source = self._run.source(self._store)
        source.refresh()
        surfaces = {} if self.costs is None else dict(zip(self.costs.rows.tolist(), self.costs.surface, strict=True))
        views = []
        for row in references.keys() & images.keys():
            a, b = references[row].half_a, references[row].half_b
            views.append(HeldOutView(row, images[row], a, b, source.read(row).buffers, surfaces.get(row)))
        return sorted(views, key=lambda view: view.row)
