"""All that a report says, gathered once for its page, its Markdown and its JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.shared.frame_costs import FrameCosts
from photonfarm.shared.records import F32, ViewBuffers, arrays_of
from photonfarm.trainer import evaluate
from photonfarm.trainer.evaluate import Evaluation, Row, Tell
from photonfarm.trainer.evaluation_samples import Samples, read_references
from photonfarm.trainer.report.dataset_card import DatasetCard
from photonfarm.trainer.report.frame_times import FrameTime, frame_time, measured_costs
from photonfarm.trainer.report.gauges import Gauges
from photonfarm.trainer.report.published import Published, table_of
from photonfarm.trainer.report.trained_runs import RunStory, short_names
from photonfarm.trainer.report.worst_cases import View, WorstCase, worst_cases
from photonfarm.trainer.settings import MOST_HELD_OUT, UntrainedDenoiser
from photonfarm.trainer.store_source import StoreSource
from photonfarm.trainer.trained import TrainedRun
from photonfarm.trainer.untrained import Untrained

TIMED = 9  # frames


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A row of the report's tables."""

    name: str
    row: Row
    time: FrameTime | None  # None where the renderer is not installed
    published: Published | None  # the paper's row of the same architecture


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """A report: the data, the runs, what their networks are worth, and where the first of them fails."""

    card: DatasetCard
    stories: tuple[RunStory, ...]
    gauges: Gauges
    evaluation: Evaluation
    entries: tuple[Entry, ...]
    costs: FrameCosts | None
    untimed: str  # why there are no costs
    worst: tuple[WorstCase, ...]
    published: str | None  # which of the paper's tables stands beside ours

    @property
    def measure(self) -> Entry:
        """The entry that times are ratios of: light_transport, or else the first."""
        return next((entry for entry in self.entries if entry.name == "light_transport"), self.entries[0])

    def document(self) -> dict[str, Any]:
        """The figures of report.json."""
        rows = self.evaluation.document()
        for row, entry in zip(rows["rows"], self.entries, strict=True):
            row["name"] = entry.name
            row["frame_seconds"] = None if entry.time is None else {**asdict(entry.time), "total": entry.time.total}
            row["published"] = None if entry.published is None else asdict(entry.published)
        return {
            "dataset": self.card.document(),
            "runs": [story.document() for story in self.stories],
            "mean_colour": self.gauges.mean_colour.error.mean,
            "untrained": self.gauges.untrained.error.mean,
            "evaluation": rows,
            "edit_seconds": None if self.costs is None else float(np.median(self.costs.edit_s)),
            "published_table": self.published,
            "worst_cases": [asdict(case) for case in self.worst],
        }


def gathered(
    store: str | Path,
    runs: Sequence[TrainedRun],
    denoisers: Sequence[tuple[UntrainedDenoiser, int]],
    *,
    references: Path | None,
    inception: Path | None,
    most: int = MOST_HELD_OUT,
    device: str = "auto",
    tell: Tell | None = None,
    timed: bool = True,
) -> Contents:
    """Measure everything, without the times of frames where they are not wanted. Raises what `compare` raises."""
    first = runs[0]
    card = DatasetCard.of(store, first.scene_id)
    gauges = Gauges.of(store, first)
    samples = Samples.of(StoreSource(store, first.scene_id), min(run.settings.hold_out for run in runs), most)
    rows = list(read_references(references, samples)) if references else samples.rows[:TIMED]
    kept = [k for k in (1, *(run.needs.kept for run in runs), *(k for _, k in denoisers)) if k]
    measured = measured_costs(store, first.scene_id, rows, kept) if timed else "it was not asked for"
    costs = None if isinstance(measured, str) else measured
    worst: list[WorstCase] = []

    def choose(images: Mapping[int, F32]) -> list[int]:
        if references:
            worst.extend(worst_cases(_views(samples, references, images, costs)))
        return [case.row for case in worst]

    evaluation = evaluate.compare(
        store, runs, denoisers, references=references, inception=inception, most=most, device=device, tell=tell,
        choose=choose,
    )  # fmt: skip
    found = table_of(card.spec)
    names = short_names(list(runs))
    return Contents(
        card=card,
        stories=tuple(RunStory.of(name, run) for name, run in zip(names, runs, strict=True)),
        gauges=gauges,
        evaluation=evaluation,
        entries=tuple(_entries(evaluation, names, (runs, denoisers), costs, found[1] if found else {})),
        costs=costs,
        untimed=measured if isinstance(measured, str) else "",
        worst=tuple(worst),
        published=found[0] if found else None,
    )


def _entries(
    evaluation: Evaluation,
    names: list[str],
    measured: tuple[Sequence[TrainedRun], Sequence[tuple[UntrainedDenoiser, int]]],
    costs: FrameCosts | None,
    table: Mapping[str, Published],
) -> list[Entry]:
    runs, denoisers = measured
    untrained = [Untrained(denoiser, kept, runs[0].settings) for denoiser, kept in denoisers]
    predictors: list[TrainedRun | Untrained] = [*runs, *untrained]
    entries = []
    for place, (predictor, row) in enumerate(zip(predictors, evaluation.rows, strict=True)):
        name = names[place] if place < len(names) else row.name
        time = None if costs is None else frame_time(predictor, row.seconds, costs)
        entries.append(Entry(name, row, time, table.get(name)))
    return entries


def _views(samples: Samples, folder: Path, images: Mapping[int, F32], costs: FrameCosts | None) -> list[View]:
    """The views that have references, with the images that the first network made of them."""
    exposure = np.float32(samples.source.spec.exposure)
    surfaces = {} if costs is None else dict(zip(costs.rows.tolist(), costs.surface, strict=True))
    views = []
    for row, reference in read_references(folder, samples).items():
        if row not in images:
            continue
        (sample,) = samples.source.read_batch([row])
        buffers = ViewBuffers(**{name: part.astype(np.float32) for name, part in arrays_of(sample.buffers).items()})
        a, b = (exposure * half.astype(np.float32) for half in (reference.half_a, reference.half_b))
        views.append(View(row, images[row], a, b, buffers, surfaces.get(row)))
    return views
