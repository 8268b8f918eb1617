"""The plots of a report, as SVG: error over its cost, and over the time of a frame [supplement Fig. 5]."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

from photonfarm.core.statistics import Estimate
from photonfarm.trainer.metrics import confidence_interval
from photonfarm.trainer.metrics.image_metrics import TITLES
from photonfarm.trainer.report.contents import ReportContents, ReportEntry
from photonfarm.trainer.report.trained_runs import CurvePoint, RunStory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FEW = 3  # places along an axis: fewer show no curve
FAR_BELOW = 4  # a level so many times below all curves is not drawn: it would press them together
LINEAR = ("mssim", "kid")  # the metrics whose axes are linear
NARROW = 20  # times the least value: axes of less have ticks at round numbers…
TIGHT = 2.5  # …and of less than this at equal distances
SIZE = (4.6, 4.2)  # inches, of 72 CSS pixels and a third each; the legend's rows are in it
STYLE: dict[Any, Any] = {  # names of matplotlib
    "svg.fonttype": "none",  # letters stay letters: small files, and the reader's own font
    "svg.hashsalt": "photonfarm",  # equal plots are equal bytes
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
COLOURS = (
    "#1f5fa8",
    "#c2571a",
    "#3b8f4d",
    "#8a4fa3",
    "#8c6d31",
    "#777777",
    "#d62728",
    "#17a2b8",
    "#e377c2",
    "#a6a61a",
    "#111111",
    "#8fbcff",
)
"""The colours of the predictors, by their places in the tables, in all plots; they repeat beyond twelve."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot, and its content in words."""

    name: str  # of its file
    about: str
    svg: bytes


CURVES, TIMES = "curve-", "time-"
"""The beginnings of the names of both kinds of plots."""

OF_CURVES = (
    "Held-out error of linear radiance × exposure, the targets' noise taken out, over what had been spent by then. "
    "Hollow points were measured on fewer held-out samples than the last: the others had not been rendered."
)


def group_by_kind(drawn: Sequence[Plot]) -> list[tuple[str, str, list[Plot]]]:
    """The title, an explanation, and the plots of each kind, without empty kinds."""
    kinds = (("Metrics over the time of a frame", OF_TIME, TIMES), ("Learning", OF_CURVES, CURVES))
    groups = [(title, text, [plot for plot in drawn if plot.name.startswith(kind)]) for title, text, kind in kinds]
    return [each for each in groups if each[2]]


def draw_plots(contents: ReportContents) -> list[Plot]:
    """Learning curves, then each metric over the time of a frame if that is known."""
    return [*_draw_curves(contents), *_draw_over_time(contents)]


def _draw(name: str, about: str, draw: Callable[[Axes], None]) -> Plot:
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(SIZE, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure.add_subplot())
        figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=2)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Plot(name, about, stream.getvalue())


# -------------------------------------------------------------------------------------------------------------- curves


def _draw_curves(contents: ReportContents) -> Iterator[Plot]:
    per_sample = contents.card.core_s_per_sample
    on_gpu = " (a GPU's: wall seconds)" if any(story.on_gpu for story in contents.stories) else ""
    axes: tuple[tuple[str, str, Callable[[RunStory, CurvePoint], float]], ...] = (
        ("samples", "samples drawn, repeats counted", lambda _, point: point.draws),
        ("rendering", "core-seconds of rendering", lambda _, point: point.core_s(per_sample)),
        (
            "all",
            f"core-seconds of rendering and of training{on_gpu}",
            lambda story, point: point.core_s(per_sample) + story.step_core_s(point),
        ),
    )
    for name, label, x in axes:
        if max(len({x(story, point) for point in story.curve}) for story in contents.stories) < FEW:
            continue  # everything was rendered before the first validation
        about = f"Held-out error over {label}"
        yield _draw(f"{CURVES}{name}", about, partial(_plot_curve, contents=contents, x=x, label=label))


def _plot_curve(axes: Axes, contents: ReportContents, x: Callable[[RunStory, CurvePoint], float], label: str) -> None:
    for story, colour in zip(contents.stories, cycle(COLOURS), strict=False):
        shown = [point for point in story.curve if point.error > 0]
        places = [(x(story, point), point.error) for point in shown]
        whole = [place for place, point in zip(places, shown, strict=True) if point.held_out == shown[-1].held_out]
        axes.plot(
            *_place_columns(places), color=colour, linewidth=1.2, marker="o", markersize=4, markerfacecolor="white"
        )
        axes.plot(*_place_columns(whole), "o", markersize=4, color=colour, label=story.name)
    axes.set_yscale("log")
    lowest = axes.get_ylim()[0]
    levels = {
        "mean colour": contents.baselines.mean_colour.error.mean,
        "noise of the targets": contents.evaluation.noise_floor,
    }
    for (name, value), style in zip(levels.items(), ("--", ":"), strict=True):
        if value > lowest / FAR_BELOW:
            axes.axhline(value, linestyle=style, color="#555555", linewidth=1, label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("held-out squared error, linear")
    _set_plain_ticks(axes)


def _place_columns(places: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in places], [y for _, y in places]


# ------------------------------------------------------------------------------------------------------ over frame time


@dataclass(frozen=True, slots=True)
class PlottedPredictor:
    """A predictor in a plot over the time of a frame."""

    milliseconds: float
    name: str
    group: str  # of GROUPS
    colour: str
    value: Estimate


def _draw_over_time(contents: ReportContents) -> Iterator[Plot]:
    for name, title in TITLES.items():
        points = [
            PlottedPredictor(1e3 * entry.time.total, entry.name, _name_group(entry), colour, entry.estimates[name])
            for entry, colour in zip(contents.entries, cycle(COLOURS), strict=False)
            if entry.time is not None and name in entry.estimates
        ]
        if len(points) > 1:
            about = f"{title} over the time of a frame"
            yield _draw(f"{TIMES}{name}", about, partial(_scatter, metric=name, points=points))


GROUPS = {"networks": ("D", ""), "denoisers, trained": ("o", "-"), "denoisers, not trained on the scene": ("s", "--")}
"""The kinds of predictors, each with its marker and the line that joins them; `OF_TIME` explains them."""

OF_TIME = (
    "Diamonds are networks, circles denoisers that were trained on the scene, squares denoisers that nobody trained on "
    "it; bars are 95 % intervals, which FID has none of. Less is better, but for MSSIM. All axes are logarithmic but "
    "those of MSSIM and KID; bars that would reach below half the least value end at the axis."
)


def _name_group(entry: ReportEntry) -> str:
    networks, trained, ready = GROUPS
    if not entry.row.kept:
        return networks
    return ready if entry.architecture is None else trained


def _scatter(axes: Axes, metric: str, points: Sequence[PlottedPredictor]) -> None:
    least = min(point.value.mean for point in points)
    logarithmic = metric not in LINEAR and least > 0
    floor = least / 2 if logarithmic else -math.inf
    lowest = math.inf
    for name, (marker, line) in GROUPS.items():
        members = sorted((p for p in points if p.group == name), key=lambda p: (p.milliseconds, p.name))
        places = _place_columns([(p.milliseconds, p.value.mean) for p in members])
        axes.plot(*places, linestyle=line or "none", color="#999999", linewidth=1)
        for p in members:
            mean = p.value.mean
            low, high = confidence_interval(p.value) or (mean, mean)
            lowest = min(lowest, low)
            axes.errorbar(
                p.milliseconds,
                mean,
                [[mean - max(low, floor)], [high - mean]],
                fmt=marker,
                color=p.colour,
                label=p.name,
                markersize=5,
                elinewidth=0.8,
            )
    axes.set_xscale("log")
    if logarithmic:
        axes.set_yscale("log")
        if lowest < floor:
            axes.set_ylim(bottom=floor)
    _set_plain_ticks(axes)
    axes.set_xlabel("time per frame, ms")
    axes.set_ylabel(TITLES[metric])


# ---------------------------------------------------------------------------------------------------------------- axes


def _set_plain_ticks(axes: Axes) -> None:
    """Write round numbers in full on logarithmic axes of a range so small that few powers of ten lie in it."""
    from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log" and high < NARROW * low:
            axis.set_major_locator(
                MaxNLocator(5, steps=[1, 2, 5, 10])
                if high < TIGHT * low
                else FixedLocator(_choose_round_numbers(low, high))
            )
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_locator(NullLocator())


def _choose_round_numbers(low: float, high: float) -> list[float]:
    """The numbers 1, 2, 3, 5 and 7, times powers of ten, that lie between two values."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [number for decade in decades for one in (1, 2, 3, 5, 7) if low <= (number := one * 10.0**decade) <= high]
