"""The plots of a report, as SVG: error over what was spent on it, and over the time of a frame [supplement Fig. 5]."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from photonfarm.trainer.report.contents import Contents, Entry
from photonfarm.trainer.report.trained_runs import Point, RunStory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAR_BELOW = 4  # a level so many times below all curves is not drawn: it would press them together
NARROW = 20  # times the least value: axes of less have ticks at round numbers
SIZE = (5.2, 3.6)  # inches, of 72 CSS pixels and a third each
STYLE: dict[Any, Any] = {  # names of matplotlib
    "svg.fonttype": "none",  # letters stay letters: small files, and the reader's own font
    "svg.hashsalt": "photonfarm",  # equal plots are equal bytes
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.prop_cycle": "cycler('color', ['#1f5fa8', '#c2571a', '#3b8f4d', '#8a4fa3', '#8c6d31', '#777777', '#d62728', "
    "'#17a2b8', '#e377c2', '#a6a61a', '#111111', '#8fbcff'])",
}


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot, and what it shows in words."""

    name: str  # of its file
    about: str
    svg: bytes


def plots(contents: Contents) -> list[Plot]:
    """Learning curves, then each metric over the time of a frame where that is known."""
    return [*_curves(contents), *_over_time(contents)]


def _drawn(name: str, about: str, draw: Callable[[Axes], None]) -> Plot:
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(SIZE, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure.add_subplot())
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return Plot(name, about, stream.getvalue())


# -------------------------------------------------------------------------------------------------------------- curves


def _curves(contents: Contents) -> Iterator[Plot]:
    per_sample = contents.card.core_s_per_sample
    on_gpu = " (a GPU's: wall seconds)" if any(story.on_gpu for story in contents.stories) else ""
    axes: tuple[tuple[str, str, Callable[[RunStory, Point], float]], ...] = (
        ("samples", "samples drawn", lambda _, point: point.draws),
        ("rendering", "core-seconds of rendering the samples used", lambda _, point: point.core_s(per_sample)),
        (
            "all", f"core-seconds of that and of training steps{on_gpu}",
            lambda story, point: point.core_s(per_sample) + story.step_core_s(point),
        ),
    )  # fmt: skip
    for name, label, x in axes:
        about = f"Held-out error over {label}"
        yield _drawn(f"curve-{name}", about, partial(_curve, contents=contents, x=x, label=label))


def _curve(axes: Axes, contents: Contents, x: Callable[[RunStory, Point], float], label: str) -> None:
    for story in contents.stories:
        shown = [(x(story, point), point.error) for point in story.curve if point.error > 0]
        axes.plot(*zip(*shown, strict=True) if shown else ([], []), marker=".", label=story.name, linewidth=1.2)
    axes.set_yscale("log")
    lowest = axes.get_ylim()[0]
    colour, noise = contents.gauges.mean_colour.error.mean, contents.evaluation.noise_floor
    levels = {"mean colour": colour, "noise of the targets": noise}
    for (name, value), style in zip(levels.items(), ("--", ":"), strict=True):
        if value > lowest / FAR_BELOW:
            axes.axhline(value, linestyle=style, color="#555555", linewidth=1, label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("held-out squared error, linear")
    _plain_ticks(axes)
    _legend(axes)


# ------------------------------------------------------------------------------------------------------ over frame time


@dataclass(frozen=True, slots=True)
class Measure:
    """A metric of the tables."""

    name: str
    title: str
    of: Callable[[Entry], float | None]


def measures() -> list[Measure]:
    """The metrics of Fig. 5, and those that we put beside them."""

    def feature(block: int) -> Measure:
        def value(entry: Entry) -> float | None:
            found = entry.row.metrics
            return None if found is None or found.feature_l1 is None else found.feature_l1[block].estimate.mean

        return Measure(f"feature-l1-{block}", f"Feature L1, Inception block {block}", value)

    def of(field: str) -> Callable[[Entry], float | None]:
        return lambda entry: None if entry.row.metrics is None else getattr(entry.row.metrics, field).estimate.mean

    def fid(entry: Entry) -> float | None:
        found = entry.row.metrics
        return None if found is None or found.fid is None else found.fid.value

    def kid(entry: Entry) -> float | None:
        found = entry.row.metrics
        return None if found is None or found.kid is None else found.kid.mean

    return [
        Measure("mse", "MSE", of("mse")),
        Measure("mssim", "MSSIM", of("mssim")),
        Measure("fid", "FID", fid),
        *(feature(block) for block in range(4)),
        Measure("kid", "KID", kid),
        Measure("flip", "FLIP", of("flip")),
    ]


def _over_time(contents: Contents) -> Iterator[Plot]:
    timed = [entry for entry in contents.entries if entry.time is not None]
    for measure in measures():
        points = [(entry, value) for entry in timed if (value := measure.of(entry)) is not None]
        if len(points) > 1:
            about = f"{measure.title} over the time of a frame"
            yield _drawn(f"time-{measure.name}", about, partial(_scatter, measure=measure, points=points))


GROUPS = {"networks": ("D", ""), "denoisers, trained": ("o", "-"), "denoisers, not trained on the scene": ("s", "--")}
"""Kinds of predictors, each with how matplotlib marks them and joins them by a line."""


def _group(entry: Entry) -> str:
    networks, trained, untrained = GROUPS
    if not entry.row.kept:
        return networks
    return untrained if entry.architecture is None else trained


def _scatter(axes: Axes, measure: Measure, points: Sequence[tuple[Entry, float]]) -> None:
    for name, (marker, line) in GROUPS.items():
        members = [(1e3 * entry.time.total, value, entry.name) for entry, value in points
                   if entry.time and _group(entry) == name]  # fmt: skip
        if members:
            joined = sorted(members)
            axes.plot(
                [x for x, _, _ in joined], [y for _, y, _ in joined],
                linestyle=line, marker=marker, label=name, color="#999999", markersize=3, linewidth=1,
            )  # fmt: skip
        for x, y, label in members:
            axes.plot(x, y, marker, label=label, markersize=5)
    axes.set_xscale("log")
    if measure.name not in ("mssim", "kid") and min(value for _, value in points) > 0:
        axes.set_yscale("log")
    _plain_ticks(axes)
    axes.set_xlabel("time per frame, ms")
    axes.set_ylabel(measure.title)
    _legend(axes)


# ---------------------------------------------------------------------------------------------------------------- axes


def _legend(axes: Axes) -> None:
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))


def _plain_ticks(axes: Axes) -> None:
    """Round numbers on logarithmic axes of so little that few powers of ten lie in them, written in full."""
    from matplotlib.ticker import MaxNLocator, NullLocator

    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log" and high < NARROW * low:
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_locator(NullLocator())
