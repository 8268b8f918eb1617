"""The plots of a report, as SVG: error over its cost, and over the time of a frame [supplement Fig. 5]."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

from photonfarm.trainer.metrics.image_metrics import TITLES, confidence_interval
from photonfarm.trainer.report.contents import ReportContents, ReportEntry
from photonfarm.trainer.report.data_and_runs import CurvePoint, RunStory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FEW = 3  # places along an axis: fewer show no curve
FAR_BELOW = 4  # a level so many times below all curves is not drawn: it would press them together
LINEAR = ("mssim", "kid")  # the metrics whose axes are linear
SIZE = (4.6, 4.2)  # inches, of 72 CSS pixels and a third each; LEGEND_ROWS of the legend are in it
LEGEND_ROWS, ROW = 6, 0.17  # further rows come on top, so many inches each
STYLE: dict[Any, Any] = {  # names of matplotlib
    "svg.fonttype": "none",  # letters stay letters: small files, and the reader's own font
    "svg.hashsalt": "photonfarm",  # equal plots are equal bytes
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
}
COLOURS = [
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
]
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
        set_plain_ticks(axes)
        rows = -(-len(axes.get_legend_handles_labels()[1]) // 2)
        figure.set_size_inches(SIZE[0], SIZE[1] + ROW * max(0, rows - LEGEND_ROWS))
        figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=2)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Plot(name, about, stream.getvalue())


def set_plain_ticks(axes: Axes) -> None:
    """Write round numbers in full on logarithmic axes of a range so small that few powers of ten lie in it."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log" and high < 100 * low:
            few, subs = high < 2.5 * low, (1, 2, 3, 5, 7) if high < 20 * low else (1, 2, 5)
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]) if few else LogLocator(subs=subs))
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_locator(NullLocator())


# -------------------------------------------------------------------------------------------------------------- curves

OF_CURVES = (
    "Held-out error of linear radiance × exposure, the targets' noise taken out, over what had been spent by then. "
    "Hollow points were measured on fewer held-out views than the last: the others had not been rendered."
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
    baselines = contents.baselines
    levels = (
        (baselines.than.removeprefix("the "), baselines.given.error.mean, "--"),
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


Plotted = tuple[ReportEntry, str]
"""A predictor whose frame was timed, and its colour."""


def _draw_over_time(contents: ReportContents) -> Iterator[Plot]:
    for name, title in TITLES.items():
        colours = dict(zip(dict.fromkeys(map(_name_series, contents.entries)), cycle(COLOURS), strict=False))
        plotted = [
            (entry, colours[_name_series(entry)])
            for entry in contents.entries
            if entry.time is not None and name in entry.estimates
        ]
        if len(plotted) > 1:
            yield _draw(f"time-{name}", f"{title} over the time of a frame", partial(_scatter, name, plotted))


def _name_group(entry: ReportEntry) -> str:
    networks, trained, ready = GROUPS
    if not entry.row.kept:
        return networks
    return ready if entry.architecture is None else trained


def _name_series(entry: ReportEntry) -> str:
    """The name of what has one colour: a predictor, however much it is given."""
    return entry.name.removesuffix(f" {entry.row.halves}/1") if entry.architecture else entry.name.split(" ")[0]


def _name_line(entry: ReportEntry) -> str:
    """What one line joins: the denoisers of the paper, or how much a predictor is given."""
    return "" if (entry.architecture or "").startswith("denoise_") else _name_series(entry)


def _place(entry: ReportEntry, metric: str) -> tuple[float, float]:
    """The time of a frame in milliseconds, and the metric."""
    return 1e3 * entry.time.total if entry.time else 0.0, entry.estimates[metric].mean


def _scatter(metric: str, plotted: Sequence[Plotted], axes: Axes) -> None:
    for name, (marker, line) in GROUPS.items():
        members = sorted((each for each in plotted if _name_group(each[0]) == name), key=lambda e: _place(e[0], metric))
        for joined in dict.fromkeys(_name_line(entry) for entry, _ in members):
            x, y = zip(*(_place(entry, metric) for entry, _ in members if _name_line(entry) == joined), strict=True)
            axes.plot(x, y, linestyle=line, color="#999999", linewidth=1)
        named: set[str] = set()
        for entry, colour in members:
            interval = confidence_interval(entry.estimates[metric])
            reach = entry.estimates[metric].mean - interval[0] if interval else 0.0
            look: dict[str, Any] = {
                "fmt": marker,
                "color": colour,
                "label": None if _name_series(entry) in named else _name_series(entry),
                "markersize": 5,
                "elinewidth": 0.8,
            }
            named.add(_name_series(entry))
            axes.errorbar(*_place(entry, metric), reach, **look)
    axes.set_xscale("log")
    least = min(_place(entry, metric)[1] for entry, _ in plotted)
    if metric not in LINEAR and least > 0:
        axes.set_yscale("log", nonpositive="clip")
        axes.set_ylim(bottom=max(axes.get_ylim()[0], least / 2))
    axes.set(xlabel="time per frame, ms", ylabel=TITLES[metric])
