#!/usr/bin/env python3
"""Error against the time of a frame, everything charged: ours beside denoisers that take as long.

    python experiments/equal_time.py NAME … [--size small] [--work build/experiments] [--picture FILE.png]

prints of experiments that have run, or of looks at them (run.py, `--networks`), ours beside the best denoiser of each
moment, and most rows; the picture has all.

Time is that of editing the scene, buffers, guides, photons, what is rendered, and the network. A family is one way to
make an image of more or fewer samples, such as a denoiser in its qualities: of it count those that nothing quicker has
less error than, and between two of these the error is taken to follow a power of the time. Of ours each row counts by
itself: by how many halves it is given, and by how many steps it was trained (NETWORK-STEPS).

Exit code 0, 3 for a name that no experiment has, or 7 where one has no report.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from bench.harness import results
from experiments.experiment import Experiment, SizeName
from experiments.rooms import Room
from photonfarm.core.errors import IncompleteError, PhotonfarmError
from photonfarm.core.formatting import format_markdown_table
from photonfarm.core.statistics import Estimate
from photonfarm.trainer.metrics.image_metrics import confidence_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

F64 = NDArray[np.float64]

OURS = ("guided_transport", "guided_transport_photons", "guided_denoise")
NETWORKS = ("cnn", "feature_projection", "light_transport", "light_transport_photons", "guided", *OURS)
LONGER = re.compile(r"(?P<network>\w+)-\d+")
"""The name of a run that took so many steps, where others of its network took as many as the size says."""

FAMILIES = {
    r"denoise_\d+(_reflectance)?(-\d+)?": "denoisers trained on the room",
    r"oidn\S*(?<!reflectance) .*": "OIDN by albedo",
    r"oidn\S*reflectance .*": "OIDN by reflectance",
    r"none .*": "bdpt",
    r"path .*": "path",
}
"""The names of a family's rows, as a regular expression, and what it is called."""

DENOISERS = tuple(FAMILIES)[:3]

LEFT_OUT = re.compile(r".* (2/1|8/1|1/\d\d?)(?<! 1/1)")
"""The names of rows that tables of all rows leave out, so that they can be read."""

LOOKS = {"s": "-", "o": "--", "^": "-", "x": ":", "+": "-."}
"""How each family is drawn: its markers and its line."""

LEAST = 1e-9  # of an error that is taken to a power
COLUMNS = 2
GREY = "#777777"  # of denoisers; no network has it
REPLICATES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A predictor in a room."""

    name: str
    milliseconds: float
    errors: F64  # (views,) MSE of each image, the mean of all seeds

    @property
    def mse(self) -> float:
        """The mean squared error over all views."""
        return float(self.errors.mean())


@dataclass(frozen=True, slots=True, eq=False)
class AtTime:
    """The error that a family has after a time: that of `first` to the power 1 − share, times that of `second`."""

    first: Placed
    second: Placed
    share: float
    beyond: bool = False  # of one alone, which takes less time; so that the family could reach less in that time

    def of(self, first: F64, second: F64) -> F64:
        """The error from those of both; an estimate that noise made negative counts as next to nothing."""
        first, second = (np.maximum(each, LEAST) for each in (first, second))
        mixed: F64 = first ** (1 - self.share) * second**self.share
        return mixed


def find_network(name: str) -> str:
    """The network of a row, whatever its steps and however many halves it is given."""
    run = name.split(" ")[0]
    return longer["network"] if (longer := LONGER.fullmatch(run)) else run


def group_networks(room: Room, networks: Sequence[str]) -> dict[str, list[str]]:
    """The rows of these networks by the run, in their order: those of several halves are of one run."""
    of = {name: networks.index(find_network(name)) for name in room.rows if find_network(name) in networks}
    runs: dict[str, list[str]] = {}
    for name in sorted(of, key=lambda name: of[name]):
        runs.setdefault(name.split(" ")[0], []).append(name)
    return runs


def list_longest(rooms: Sequence[Room]) -> list[str]:
    """Rows of OURS that tables show: those that were trained longer than others, or all where none was."""
    known = dict.fromkeys(name for room in rooms for of_run in group_networks(room, OURS).values() for name in of_run)
    shown = [name for name in known if not LEFT_OUT.fullmatch(name)]
    return [name for name in shown if LONGER.fullmatch(name.split(" ")[0])] or shown


def place_rows(room: Room, names: Sequence[str]) -> list[Placed]:
    """Those of the rows that were timed and have errors, by ascending time. Raises SpecError as `Room.errors` does."""
    edit, entries = room.document["edit_seconds"], []
    for name in names:
        time, errors = room.rows.get(name, {}).get("frame_seconds"), room.errors(name)
        if edit is not None and time and errors is not None:
            entries.append(Placed(name, 1e3 * (edit + time["total"]), errors.mean(axis=0)))
    return sorted(entries, key=lambda each: each.milliseconds)


def order_family(room: Room, names: str) -> list[Placed]:
    """Those members of a family that nothing quicker has less error than, by ascending time."""
    best: list[Placed] = []
    for each in place_rows(room, [name for name in room.rows if re.fullmatch(names, name)]):
        if not best or each.mse < best[-1].mse:
            best.append(each)
    return best


def interpolate(members: Sequence[Placed], milliseconds: float) -> AtTime | None:
    """The least error of a family after so many milliseconds; None where all of it takes longer."""
    in_time = [each for each in members if each.milliseconds <= milliseconds]
    if not in_time:
        return None
    best = min(in_time, key=lambda each: each.mse)
    reached = AtTime(best, best, 0.0, beyond=best.milliseconds < milliseconds)
    if len(in_time) < len(members):
        last, after = in_time[-1], members[len(in_time)]
        share = np.log(milliseconds / last.milliseconds) / np.log(after.milliseconds / last.milliseconds)
        between = AtTime(last, after, float(share))
        if between.of(np.array(last.mse), np.array(after.mse)) < best.mse:
            reached = between
    return reached


def measure_ratio(ours: Placed, theirs: AtTime) -> tuple[float, float, float]:
    """Our error over theirs, and its 95 % interval: a bootstrap over configurations, the same for both."""
    errors = np.stack([ours.errors, theirs.first.errors, theirs.second.errors])
    views = errors.shape[1]
    drawn = np.random.default_rng(0).multinomial(views, np.full(views, 1 / views), size=REPLICATES) @ errors.T / views
    means = np.concatenate([errors.mean(axis=1)[None], drawn])
    ratios = means[:, 0] / theirs.of(means[:, 1], means[:, 2])
    low, high = np.quantile(ratios[1:], (0.025, 0.975))
    return float(ratios[0]), float(low), float(high)


def format_rows(rooms: Sequence[Room]) -> str:
    """Rows that were timed and have errors: in each room the error, half its 95 % interval, and (ms a frame)."""
    shown = [[name for name in room.rows if not LEFT_OUT.fullmatch(name)] for room in rooms]
    placed = [{each.name: each for each in place_rows(*each)} for each in zip(rooms, shown, strict=True)]
    lines = [
        [name, *(_format_error(of_room.get(name)) for of_room in placed)]
        for name in dict.fromkeys(name for room in rooms for name in room.rows)
        if any(name in of_room for of_room in placed)
    ]
    return format_markdown_table(["MSE ± 95 % (ms)", *(room.name for room in rooms)], lines)


def _format_error(placed: Placed | None) -> str:
    if placed is None:
        return ""
    interval = confidence_interval(Estimate.of(placed.errors))
    reach = f" ± {interval[1] - placed.mse:.5f}" if interval else ""
    return f"{placed.mse:.5f}{reach} ({placed.milliseconds:.0f})"


def format_best(rooms: Sequence[Room], networks: Sequence[str]) -> str:
    """Rows of ours in each room that has any: error, time, and that error over the least of a denoiser by then."""
    lines = []
    for room in rooms:
        if placed := {each.name: each for each in place_rows(room, networks)}:
            cells = (_format_best(room, placed[name]) if name in placed else "" for name in networks)
            lines.append([room.name, *cells])
    return format_markdown_table(["room", *networks], lines)


def _format_best(room: Room, ours: Placed) -> str:
    families = [order_family(room, names) for names in DENOISERS]
    reached = [
        (measure_ratio(ours, theirs)[0], members)
        for members in families
        if (theirs := interpolate(members, ours.milliseconds))
    ]
    if reached:
        share = _format_ratio(ours, max(reached, key=lambda each: each[0])[1])
    else:
        first = min((members[0] for members in families if members), key=lambda each: each.milliseconds)
        later, (ratio, low, high) = (
            first.milliseconds - ours.milliseconds,
            measure_ratio(ours, AtTime(first, first, 0.0)),
        )
        share = f"first, {first.name} comes {later:.0f} ms later: {ratio:.2f} ({low:.2f} … {high:.2f})"
    return f"{ours.mse:.5f}, {ours.milliseconds:.0f} ms: {share}"


def format_table(rooms: Sequence[Room]) -> str:
    """Ours in each room: time, error, and that as a share of each family's after the same time."""
    head = ["room", "network", "ms a frame", "MSE"]
    head += [f"MSE over that of {called} (95 %)" for called in FAMILIES.values()]
    lines = []
    for room in rooms:
        for ours in place_rows(room, [name for of_run in group_networks(room, OURS).values() for name in of_run]):
            line = [room.name, ours.name, f"{ours.milliseconds:.0f}", f"{ours.mse:.5f}"]
            lines.append([*line, *(_format_ratio(ours, order_family(room, names)) for names in FAMILIES)])
    return format_markdown_table(head, lines)


def _format_ratio(ours: Placed, members: Sequence[Placed]) -> str:
    theirs = interpolate(members, ours.milliseconds)
    if theirs is None:
        return f"all take longer, from {members[0].milliseconds:.0f} ms" if members else "n/a"
    share, low, high = measure_ratio(ours, theirs)
    return f"{'≥ ' if theirs.beyond else ''}{share:.2f} ({low:.2f} … {high:.2f})"


def draw_picture(rooms: Sequence[Room]) -> bytes:
    """The plot of every room, as PNG."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from photonfarm.trainer.report.plots import STYLE

    rows = -(-len(rooms) // COLUMNS)
    with mpl.rc_context(STYLE):
        figure = Figure((8.4, 3.1 * rows + 0.9), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        panels = [*figure.subplots(rows, COLUMNS, squeeze=False).flat]
        for axes, room in zip(panels, rooms, strict=False):
            _draw(axes, room)
        for axes in panels[len(rooms) :]:
            axes.set_axis_off()
        handles = {
            label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside lower center", ncols=3)
        drawn, few = io.BytesIO(), io.BytesIO()
        figure.savefig(drawn, format="png")
    of_few_colours = Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    of_few_colours.save(few, "png", optimize=True)  # two fifths of the bytes
    return few.getvalue()


def _draw(axes: Axes, room: Room) -> None:
    """Draw a room's plot: families as lines, and networks."""
    from photonfarm.trainer.report.plots import COLOURS, set_plain_ticks

    colours = [colour for colour in COLOURS if colour != GREY]
    for (names, called), (marker, line) in zip(FAMILIES.items(), LOOKS.items(), strict=True):
        members = order_family(room, names)
        places = [each.milliseconds for each in members], [each.mse for each in members]
        axes.plot(*places, marker=marker, markersize=4, linestyle=line, color=GREY, label=called)
    for run, of_run in group_networks(room, NETWORKS).items():
        if members := place_rows(room, of_run):
            places = [each.milliseconds for each in members], [each.mse for each in members]
            look, fill = ("D:", "none") if run == (network := find_network(run)) else ("D-", "full")  # longer: whole
            axes.plot(*places, look, fillstyle=fill, markersize=5, color=colours[NETWORKS.index(network)], label=run)
    axes.margins(0.09, 0.1)
    axes.set(title=room.name, xlabel="ms a frame, all charged", ylabel="MSE", xscale="log", yscale="log")
    set_plain_ticks(axes)


def _read(name: str, size: SizeName, work: Path) -> Room:
    """An experiment with the runs that its report has. Raises SpecError for its name, IncompleteError without one."""
    experiment, report = Experiment.load(name, size), work / size / name / "report/report.json"
    if not report.is_file():
        raise IncompleteError(f"{report}: not there; `python experiments/run.py {name}` makes it")
    runs = [run["name"] for run in json.loads(report.read_text(encoding="utf-8"))["runs"]]
    return Room.read(experiment.only(runs), report, results.commit())


def main() -> int:
    """Print what is known of some experiments; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME")
    parser.add_argument("--size", choices=get_args(SizeName), default="small")
    parser.add_argument("--work", type=Path, default=results.ROOT / "build/experiments", help="(build/experiments)")
    parser.add_argument("--ours", nargs="+", metavar="ROW", help="which rows of ours (those trained longest)")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="where to draw all of it, as PNG")
    told = parser.parse_args()
    try:
        rooms = [_read(name, told.size, told.work) for name in told.names]
    except PhotonfarmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{format_best(rooms, told.ours or list_longest(rooms))}\n\n{format_rows(rooms)}")
    if told.picture:
        told.picture.write_bytes(draw_picture(rooms))
    return 0


if __name__ == "__main__":
    sys.exit(main())
