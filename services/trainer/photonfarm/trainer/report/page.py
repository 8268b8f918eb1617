"""The report as one HTML file that needs nothing else.

It begins with the verdict: what the first predictor has learned, in words, from numbers alone.

Shape letters: H W image.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Literal

import numpy as np

from photonfarm.core.formatting import format_count, format_milliseconds
from photonfarm.core.page import render_page
from photonfarm.core.pictures import reduce_image
from photonfarm.core.records import F32
from photonfarm.core.statistics import group_means
from photonfarm.trainer.compare import evaluation_page
from photonfarm.trainer.predictors.evaluation import HeldOutErrors
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.data_and_runs import NOTHING
from photonfarm.trainer.report.plots import PlotGroup
from photonfarm.trainer.report.tables import list_facts, make_tables
from photonfarm.trainer.report.views import ShownView, write_legend

Kind = Literal["better", "mixed", "worse"]
"""How a network compares with what it is given.

"mixed" is better in the mean over all, but not in most of them, or only by light above white.
"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """One sentence, and the sentences that say how far it can be trusted."""

    kind: Kind
    sentence: str
    further: tuple[str, ...]

    @classmethod
    def of(cls, contents: ReportContents) -> Verdict:
        """The verdict on the first entry, against what its network is given, shown as it is: training's own share.

        A network that is given nothing that is an image is compared with the mean colour.
        """
        entry, baselines, unit = contents.entries[0], contents.baselines, contents.evaluation.unit
        errors, given, than = entry.row.held_out, baselines.given, baselines.than
        shown = _compare_shown(errors, baselines.mean_shown_colour if than == NOTHING else given)
        better = group_means(errors.per_sample, errors.units) < group_means(given.per_sample, given.units)
        ratio = errors.error.mean / given.error.mean
        kind, sentence = _judge(entry.name, than, ratio, shown, float(better.mean()), unit)
        learned = f"from {baselines.untrained.error.mean:.3g} before the first step to {errors.error.mean:.3g}"
        colour = (
            "" if than == NOTHING else f"; that of one colour for every pixel is {baselines.mean_colour.error.mean:.3g}"
        )
        further = (
            f"Training took its error {learned}; it is below that of {than}, {given.error.mean:.3g}, "
            f"in {better.sum()} of {format_count(len(better), unit)} that no training saw{colour}.",
            *_compare_with_denoiser(contents),
            _describe_references(contents),
        )
        return cls(kind, sentence, further)


def _compare_with_denoiser(contents: ReportContents) -> list[str]:
    """The sentence on the best ready denoiser whose frame takes no longer than the first network's, or the quickest.

    Of those that are given several halves, only where all views have as many passes: other views are not comparable.
    """
    entry = contents.entries[0]
    alike = (each for each in contents.entries if each.row.held_out.units == entry.row.held_out.units)
    ready = {each: each.time.total for each in alike if each.architecture is None and each.time}
    if entry.time is None or not ready:
        return []
    total, quickest = entry.time.total, min(ready, key=lambda each: ready[each])
    in_time = [each for each, seconds in ready.items() if seconds <= total]
    other = min(in_time or [quickest], key=lambda each: each.row.held_out.error.mean)
    times = f"in {format_milliseconds(ready[other])} ms a frame for its {format_milliseconds(total)}"
    return [f"{other.name}, {times}, has an error of {other.row.held_out.error.mean:.3g}."]


def _compare_shown(errors: HeldOutErrors, constant: HeldOutErrors) -> float:
    """The ratio of the errors without light above white; 0 where this error is below what its samples can show."""
    own, colour = (float(group_means(of.shown, of.units).mean()) for of in (errors, constant))
    return max(own, 0.0) / colour if colour > 0 else 0.0


def _judge(name: str, than: str, ratio: float, shown: float, wins: float, unit: str) -> tuple[Kind, str]:
    """The verdict's kind and sentence, from ratios to a baseline's error and the share of units that are better.

    Of the two ratios it says the larger one: a lamp in view makes the mean colour so wrong that all else looks good.
    """
    if ratio <= 0:
        return "better", f"{name} predicts unseen {unit}s with no error that these views can show."
    if ratio >= 1:
        return "worse", f"{name} is worse than {than}: on unseen {unit}s its error is {ratio:.3g} times as large."
    if shown >= 1:
        over_all = f"over all pixels it has {_format_share(ratio)} that error"
        return "mixed", f"{name} is worse than {than} where no light is above white; {over_all}."
    share = _format_share(max(ratio, shown))
    if wins < 0.5:
        mean = f"only in the mean over all has it {share} that error"
        return "mixed", f"{name} is worse than {than} in most unseen {unit}s; {mean}."
    where = " where no light is above white" if shown > ratio else ""
    return "better", f"{name} predicts unseen {unit}s with {share} the error of {than}{where}."


def _format_share(ratio: float) -> str:
    """A ratio below 1 as people say it: "1/18 of", "37 % of"."""
    return f"1/{1 / ratio:.0f} of" if ratio <= 0.1 else f"{100 * ratio:.0f} % of"


def _describe_references(contents: ReportContents) -> str:
    """The sentence on references: what the images are compared with, and what came of it."""
    references, metrics = contents.evaluation.references, contents.entries[0].row.metrics
    if references is None or metrics is None:
        return (
            "There are no references, such as “photonfarm up --reference-views 6” renders: pictures stand beside the "
            "mean of both noisy halves, and the paper’s columns are empty."
        )
    return (
        f"As a display shows it, its MSE against {format_count(references.views, 'reference')} is "
        f"{metrics.mse.estimate.mean:.4f}, and its MSSIM {metrics.mssim.estimate.mean:.3f}."
    )


TEMPLATE = Path(__file__).with_name("report.html.j2")
VIEWER = Path(__file__).with_name("viewer.js")

LARGEST = 256  # px, along each side of what the page shows

MOST_LIGHT = 1_600_000
"""Characters of a page that light in half floats may take; layers beyond show their pictures' 8 bits, cut at white."""

LARGEST_HALF = np.float32(np.finfo(np.float16).max)


def format_page(
    contents: ReportContents, verdict: Verdict, views: Sequence[ShownView], plots: Sequence[PlotGroup]
) -> str:
    """The report's HTML."""
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {contents.card.spec.name}",
        verdict=verdict,
        measured=evaluation_page.count_views(contents.evaluation),
        views=views,
        largest=LARGEST,
        legend=write_legend(contents),
        named=contents.entries[0].name,
        light=encode_light(views),
        viewer=VIEWER.read_text(),
        plots=plots,
        tables=make_tables(contents),
        facts=list_facts(contents),
    )


def encode_light(views: Sequence[ShownView]) -> list[dict[str, str]]:
    """The light of each view's layers by their names, as many as fit: first those of all views that come first."""
    layers_by_view: list[dict[str, str]] = [{} for _ in views]
    of_views = [[each for each in (*view.images, *view.inputs) if each.light is not None] for view in views]
    left = MOST_LIGHT
    for layers in zip_longest(*of_views):  # the first of every view, then the second, and so on
        for encoded, layer in zip(layers_by_view, layers, strict=True):
            if layer is not None and layer.light is not None:
                text = encode_half_floats(layer.light)
                left -= len(text)
                if left < 0:
                    return layers_by_view
                encoded[layer.name] = text
    return layers_by_view


def encode_half_floats(light: F32) -> str:
    """Light (H, W, 3) as base64 of little-endian half floats; of a large film, the means over blocks of pixels."""
    halves = np.clip(reduce_image(np.nan_to_num(light), LARGEST), -LARGEST_HALF, LARGEST_HALF).astype("<f2")
    return b64encode(halves.tobytes()).decode()
