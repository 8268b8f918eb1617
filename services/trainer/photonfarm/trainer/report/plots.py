"""The plots of a report, as SVG: error over its cost, and over the time of a frame [supplement Fig. 5]."""

from __future__ import annotations

import io
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


@dataclass(frozen=True, slots=True)
class PlotGroup:
    """The plots of one kind, at least one, with what they show."""

    title: str
    explanation: str
    plots: tuple[Plot, ...]


def draw_plots(contents: ReportContents) -> list[PlotGroup]:
    """Learning curves, then each metric over the time of a frame if that is known."""
    groups = [
        PlotGroup("Learning", OF_CURVES, tuple(_draw_curves(contents))),
        PlotGroup("Metrics over the time of a frame", OF_TIME, tuple(_draw_over_time(contents))),
    ]
    return [group for group in groups if group.plots]


def _draw(name: str, about: str, draw: Callable[[Axes], None]) -> Plot:
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(SIZE, layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        draw(axes)
        _set_plain_ticks(axes)
        figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=2)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Plot(name, about, stream.getvalue())


def _set_plain_ticks(axes: Axes) -> None:
    """Write round numbers in full on logarithmic axes of a range so small that few powers of ten lie in it."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log" and high < 20 * low:
            few = high < 2.5 * low
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]) if few else LogLocator(subs=(1, 2, 3, 5, 7)))
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_locator(NullLocator())


# -------------------------------------------------------------------------------------------------------------- curves

OF_CURVES = (
    "Held-out error of linear radiance × exposure, the targets' noise taken out, over what had been spent by then. "
    "Hollow points were measured on fewer held-out samples than the last: the others had not been rendered."
)


def _draw_curves(contents: ReportContents) -> Iterator[Plot]:
    per_sample = contents.card.core_s_per_sample
    on_gpu = " (a GPU's: wall seconds)" if any(story.on_gpu for story in contents.stories) else ""
    axes: tuple[tuple[str, str, Callable[[RunStory, CurvePoint], float]], ...] = (
        ("samples", "samples drawn, repeats counted", lambda _, point: point.draws),
        (
            "all",
            f"core-seconds of rendering and of training{on_gpu}",
            lambda story, point: point.used * per_sample + story.step_core_s(point),
        ),
    )
    for name, label, x in axes:
        if max(len({x(story, point) for point in story.curve}) for story in contents.stories) >= FEW:
            draw = partial(_plot_curve, contents=contents, x=x, label=label)
            yield _draw(f"curve-{name}", f"Held-out error over {label}", draw)


def _plot_curve(axes: Axes, contents: ReportContents, x: Callable[[RunStory, CurvePoint], float], label: str) -> None:
    for story, colour in zip(contents.stories, cycle(COLOURS), strict=False):
        shown = [point for point in story.curve if point.error > 0]
        whole = [point for point in shown if point.held_out == shown[-1].held_out]
        for points, look in ((shown, {"linewidth": 1.2, "markerfacecolor": "white"}), (whole, {"linestyle": "none"})):
            places = [x(story, point) for point in points], [point.error for point in points]
            named = story.name if points is whole else None
            axes.plot(*places, marker="o", markersize=4, color=colour, label=named, **look)
    axes.set_yscale("log")
    lowest = axes.get_ylim()[0]
    levels = (
        ("mean colour", contents.baselines.mean_colour.error.mean, "--"),
        ("noise of the targets", contents.evaluation.noise_floor, ":"),
    )
    for name, value, style in levels:
        if value > lowest / FAR_BELOW:
            axes.axhline(value, linestyle=style, color="#555555", linewidth=1, label=name)
    axes.set(xlabel=label, ylabel="held-out squared error, linear")


# ------------------------------------------------------------------------------------------------------ over frame time

GROUPS = {
    "networks": ("D", "none"),
    "denoisers, trained": ("o", "-"),
    "denoisers, not trained on the scene": ("s", "--"),
}
"""The kinds of predictors, each with its marker and the line that joins them; `OF_TIME` explains them."""

OF_TIME = (
    "Diamonds are networks, circles denoisers that were trained on the scene, squares denoisers that nobody trained on "
    "it; bars are 95 % intervals, which FID has none of. Less is better, but for MSSIM. All axes are logarithmic but "
    "those of MSSIM and KID; bars that would reach below half the least value end at the axis."
)


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
            draw = partial(_scatter, metric=name, points=points)
            yield _draw(f"time-{name}", f"{title} over the time of a frame", draw)


def _name_group(entry: ReportEntry) -> str:
    networks, trained, ready = GROUPS
    if not entry.row.kept:
        return networks
    return ready if entry.architecture is None else trained


def _scatter(axes: Axes, metric: str, points: Sequence[PlottedPredictor]) -> None:
    logarithmic = metric not in LINEAR and min(p.value.mean for p in points) > 0
    for name, (marker, line) in GROUPS.items():
        members = sorted((p for p in points if p.group == name), key=lambda p: (p.milliseconds, p.name))
        places = [p.milliseconds for p in members], [p.value.mean for p in members]
        axes.plot(*places, linestyle=line, color="#999999", linewidth=1)
        for p in members:
            reach = p.value.mean - (confidence_interval(p.value) or (p.value.mean,))[0]
            axes.errorbar(
                p.milliseconds,
                p.value.mean,
                reach,
                fmt=marker,
                color=p.colour,
                label=p.name,
                markersize=5,
                elinewidth=0.8,
            )
    axes.set_xscale("log")
    if logarithmic:
        axes.set_yscale("log", nonpositive="clip")
        least = min(p.value.mean for p in points)
        if axes.get_ylim()[0] < least / 2:
            axes.set_ylim(bottom=least / 2)
    axes.set(xlabel="time per frame, ms", ylabel=TITLES[metric])
