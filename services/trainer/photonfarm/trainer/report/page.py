"""The report as one HTML file that needs nothing else, and as Markdown with its plots and pictures in files beside it.

Both begin with the verdict: what the first predictor has learned, in words, from numbers alone.

Shape letters: H W image.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.formatting import format_count, format_markdown_table
from photonfarm.core.page import render_page
from photonfarm.core.pictures import reduce_image
from photonfarm.core.records import F32
from photonfarm.core.statistics import group_means
from photonfarm.trainer.compare import evaluation_page
from photonfarm.trainer.compare.evaluation_samples import References
from photonfarm.trainer.metrics import ImageMetrics, confidence_interval
from photonfarm.trainer.predictors.evaluation import BLOCK, HeldOutErrors
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.plots import Plot, group_by_kind
from photonfarm.trainer.report.tables import Table, list_facts, make_tables
from photonfarm.trainer.report.views import ShownView, write_legend

LARGE = 10  # times less error: from here on it is said as a fraction, below in percent


Kind = Literal["better", "mixed", "worse"]
"""Than the mean colour; "mixed": in the mean over all, but not in most configurations, or only by light above white."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """One sentence, and the sentences that say how far it can be trusted."""

    kind: Kind
    sentence: str
    further: tuple[str, ...]

    @classmethod
    def of(cls, contents: ReportContents) -> Verdict:
        """The verdict on the first entry, against the mean colour and against the network before its first step."""
        evaluation, first = contents.evaluation, contents.entries[0]
        errors, constant = first.row.held_out, contents.baselines.mean_colour
        shown = _compare_shown(errors, contents.baselines.mean_shown_colour)
        further = (
            _describe_wins(errors, constant, shown, evaluation.unit),
            _describe_references(evaluation.references, first.row.metrics),
        )
        kind, sentence = _judge(first.name, errors, constant, shown, evaluation.unit)
        return cls(
            kind,
            f"{sentence} {_describe_progress(errors.error.mean, contents.baselines.untrained.error.mean)}",
            further,
        )


def _compare_shown(errors: HeldOutErrors, constant: HeldOutErrors) -> float:
    """The ratio of the errors without light above white; 0 where this error is below what its samples can show."""
    own, colour = (float(group_means(of.shown, of.units).mean()) for of in (errors, constant))
    return max(own, 0.0) / colour if colour > 0 else 0.0


def _judge(name: str, errors: HeldOutErrors, constant: HeldOutErrors, shown: float, unit: str) -> tuple[Kind, str]:
    """The verdict's kind and sentence.

    Of the two ratios it says the larger one: a lamp in view makes the mean colour so wrong that all else looks good.
    """
    error, colour, better = errors.error.mean, constant.error.mean, _find_better(errors, constant)
    if error <= 0:
        return "better", f"{name} predicts unseen {unit}s with no error that these views can show."
    if error >= colour:
        times = f"{error / colour:.3g} times that of one colour for every pixel"
        return "worse", f"{name} is worse than the mean colour: on unseen {unit}s its error is {times}."
    if shown >= 1:
        over_all = f"over all pixels it has {_format_share(error / colour)} that error"
        return "mixed", f"{name} is worse than the mean colour where no light is above white; {over_all}."
    share = _format_share(max(error / colour, shown))
    if 2 * better.sum() < len(better):
        mean = f"only in the mean over all has it {share} that error"
        return "mixed", f"{name} is worse than the mean colour in most unseen {unit}s; {mean}."
    return "better", f"{name} predicts unseen {unit}s with {share} the mean colour’s error."


def _format_share(ratio: float) -> str:
    """A ratio below 1 as people say it: "1/18 of", "37 % of"."""
    return f"1/{1 / ratio:.0f} of" if ratio <= 1 / LARGE else f"{100 * ratio:.0f} % of"


def _find_better(errors: HeldOutErrors, constant: HeldOutErrors) -> NDArray[np.bool_]:
    """Whether the error is below the mean colour’s, for each configuration, or view of a static scene."""
    own, other = (group_means(of.per_sample, of.units) for of in (errors, constant))
    return own < other


def _describe_wins(errors: HeldOutErrors, constant: HeldOutErrors, shown: float, unit: str) -> str:
    better, ratio = _find_better(errors, constant), errors.error.mean / constant.error.mean
    units = format_count(len(better), unit)
    won = f"Its error is below the mean colour’s in {better.sum()} of {units} that no training saw"
    if not 0 < ratio < 1 or shown == 0:
        return f"{won}."
    cut = f"{_format_share(shown)} that of one colour" if shown < 1 else "not below that of one colour"
    blocks = f"over blocks of {BLOCK} × {BLOCK} pixels and without light above white, such as lamps in view, {cut}"
    return f"{won}; over all pixels it is {_format_share(ratio)} that error, {blocks}."


def _describe_progress(error: float, start: float) -> str:
    if error <= 0:
        return f"Before its first step its error was {start:.3g}."
    if error >= start:
        return "Training has not lowered its error: it was no larger before the first step."
    return f"Training has lowered its error to {_format_share(error / start)} what it was before the first step."


def _describe_references(references: References | None, metrics: ImageMetrics | None) -> str:
    """The sentence on references: what the images are compared with, and what came of it."""
    if references is None or metrics is None:
        return (
            "There are no references, such as “photonfarm up --reference-views 6” renders: pictures stand beside the "
            "mean of both noisy halves, and the paper’s columns are empty."
        )
    mse, mssim = metrics.mse.estimate.mean, metrics.mssim.estimate.mean
    return (
        f"As a display shows it, its MSE against {format_count(references.views, 'reference')} is {mse:.4f}, and its "
        f"MSSIM {mssim:.3f}."
    )


def list_headline(contents: ReportContents) -> list[tuple[str, str]]:
    """Figures of the data and of the first entry, each with what it is."""
    card, evaluation = contents.card, contents.evaluation
    error = contents.entries[0].row.held_out.error
    reach = confidence_interval(error)
    spread = "" if reach is None else f" (95 %: {reach[0]:.2g} … {reach[1]:.2g})"
    rate = 1 / card.core_s_per_sample if card.core_s_per_sample else None
    return [
        (f"{error.mean:.3g}", f"held-out error{spread}"),
        (f"{contents.baselines.mean_colour.error.mean:.3g}", "error of the mean colour"),
        (f"{evaluation.noise_floor:.3g}", "noise of the targets, which is not in these errors"),
        (f"{card.samples.rows}", f"samples of {card.samples.planned} planned, held-out ones among them"),
        ("–" if rate is None else f"{rate:.1f}", "samples rendered per core-second"),
    ]


def format_markdown(contents: ReportContents, verdict: Verdict, drawn: list[Plot], pictures: str) -> str:
    """The page; `pictures` is the file of the held-out views, beside it as the plots NAME.svg are."""
    first, *others = make_tables(contents)
    card = "\n".join(f"- **{name}**: {value}" for name, value in list_facts(contents))
    shown = "Targets and predictions, as clip(exposure · I, 0, 1)^(1/2.2)."
    blocks = [
        f"# {contents.card.spec.name}",
        " ".join((f"**{verdict.sentence}**", *verdict.further)),
        _format_table(first),
        *(_format_plots(*kind) for kind in group_by_kind(drawn)),
        f"## Held-out views\n\n{shown}\n\n![targets and predictions]({pictures})",
        *map(_format_table, others),
        f"## The data\n\n{card}",
    ]
    return "\n\n".join(blocks) + "\n"


def _format_plots(title: str, explanation: str, drawn: list[Plot]) -> str:
    images = "\n".join(f"![{plot.about}]({plot.name}.svg)" for plot in drawn)
    return f"## {title}\n\n{explanation}\n\n{images}"


def _format_table(table: Table) -> str:
    notes = "".join(f"\n- {note}." for note in table.notes)
    return f"## {table.title}\n\n{format_markdown_table(table.head, table.rows)}\n{notes}".rstrip()


TEMPLATE = Path(__file__).with_name("report.html.j2")
VIEWER = Path(__file__).with_name("viewer.js")

LARGEST = 256  # px, along each side of what the page shows

MOST_LIGHT = 1_600_000
"""Characters of a page that light in half floats may take; layers beyond show their pictures' 8 bits, cut at white."""

LARGEST_HALF = np.float32(np.finfo(np.float16).max)


def format_page(contents: ReportContents, verdict: Verdict, views: Sequence[ShownView], drawn: list[Plot]) -> str:
    """The report's HTML."""
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {contents.card.spec.name}",
        verdict=verdict,
        headline=list_headline(contents),
        measured=evaluation_page.count_views(contents.evaluation),
        views=views,
        largest=LARGEST,
        legend=write_legend(contents),
        light=encode_light(views),
        viewer=VIEWER.read_text(),
        plots=group_by_kind(drawn),
        tables=make_tables(contents),
        facts=list_facts(contents),
    )


def encode_light(views: Sequence[ShownView]) -> list[dict[str, str]]:
    """The light of each view's layers by their names, as many as fit: first those of all views that come first."""
    layers_by_view: list[dict[str, str]] = [{} for _ in views]
    left = MOST_LIGHT
    for place, name, light in _order_by_importance(views):
        text = encode_half_floats(light)
        left -= len(text)
        if left < 0:
            break
        layers_by_view[place][name] = text
    return layers_by_view


def _order_by_importance(views: Sequence[ShownView]) -> Iterator[tuple[int, str, F32]]:
    """The first light of every view, then the second, and so on, each with the place of its view."""
    of_views = [[each for each in (*view.images, *view.inputs) if each.light is not None] for view in views]
    for number in range(max(map(len, of_views), default=0)):
        for place, layers in enumerate(of_views):
            if number < len(layers) and (light := layers[number].light) is not None:
                yield place, layers[number].name, light


def encode_half_floats(light: F32) -> str:
    """Light (H, W, 3) as base64 of little-endian half floats; of a large film, the means over blocks of pixels."""
    halves = np.clip(reduce_image(np.nan_to_num(light), LARGEST), -LARGEST_HALF, LARGEST_HALF).astype("<f2")
    return b64encode(halves.tobytes()).decode()
