#!/usr/bin/env python3
"""Puts the reports of experiments together: the paper's Tables 1 and 2 over our rooms, and what agrees with them.

    python experiments/tables.py [--size small] [--work build/experiments] [--out docs/results]

Reads WORK/SIZE/NAME/report/report.json of every experiment that has one, and leaves tables.md, tables.json
and tables.png, for the paper's size tables-paper.md and so on. Rooms that the JSON in OUT has, and that have no report
here, stay, and are said on stderr: they may have run elsewhere. Delete a room's entry, and it goes. What was found out
beyond the figures stands in experiments/findings.md, which becomes the last part of the page of the small size. Exit
code 0, 3 where a report's views are not independent, or 7 where there is neither a report nor a room that stays, or one
of either is of an earlier version.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from bench.harness import results
from experiments import equal_time
from experiments.experiment import HERE, Experiment, Part, SizeName, names
from experiments.rooms import Room, estimate
from photonfarm.shared.core.errors import IncompleteError, PhotonfarmError
from photonfarm.shared.core.estimate import Estimate
from photonfarm.trainer.compare.markdown import markdown_table
from photonfarm.trainer.metrics import HEADLINE_BLOCK, confidence_interval
from photonfarm.trainer.metrics.image_metrics import NOT_AVAILABLE
from photonfarm.trainer.report.published import FIXED_LIGHTS, MOVABLE_LIGHTS, Published, PublishedTable
from photonfarm.trainer.report.tables import with_interval

T = TypeVar("T")

PARTS: Mapping[Part, tuple[str, PublishedTable]] = {
    "fixed": ("Table 1: movable objects, fixed lights", FIXED_LIGHTS),
    "movable": ("Table 2: movable objects and lights; the lights that move are all the light", MOVABLE_LIGHTS),
    "daylight": ("The rooms of Table 2 by day: windows and sky add light that does not move", MOVABLE_LIGHTS),
    "vanishing": ("A room of Table 2 with lamps that vanish", MOVABLE_LIGHTS),
    "static": ("Static rooms", {}),
    "ablation": ("The supplement's static ablation", {}),
}
"""The page's parts: title, and the paper's figures."""

ORDER = ("cnn", "feature_projection", "light_transport", "light_transport_photons")
OURS = (
    ("feature_projection", "guided_transport"),
    ("cnn", "guided"),
    ("guided", "guided_transport"),
    ("guided_transport", "guided_transport_photons"),
)
"""What ours is compared with: the published network that lacks the same, and itself without a part."""

CLOSE = 0.1  # ≈: a gap of less than this share of the first's error


# -------------------------------------------------------------------------------------------------- the paper's table

COLUMNS = {
    "time per frame, ms": False, "network alone, ms (range)": False, "× light_transport": True, "MSE (95 %)": True,
    "MSSIM (95 %)": True, "FID": True, "KID": False, "Feature L1 (95 %)": True,
}  # fmt: skip
"""Heads of the columns, and whether the paper has such a one."""


def paper_table(rooms: Sequence[Room], published: PublishedTable) -> str:
    """The paper's columns, each a mean over the rooms that have the row; the published figure beside each."""
    head = ["architecture"]
    for column, is_published in COLUMNS.items():
        head += [column, "paper"] if published and is_published else [column]
    lines = []
    for name in _row_names(rooms):
        ours = _ours([room for room in rooms if name in room.rows], name)
        theirs = _theirs(published.get(name), published.get("light_transport"))
        line = [name]
        for cell, paper, is_published in zip(ours, theirs, COLUMNS.values(), strict=True):
            line += [cell, paper] if published and is_published else [cell]
        lines.append(line)
    return markdown_table(head, lines)


def lacking(rooms: Sequence[Room]) -> str:
    """Which rows are no mean over all rooms, a sentence; empty where all are."""
    without = {name: [room.name for room in rooms if name not in room.rows] for name in _row_names(rooms)}
    said = "; ".join(f"{name} without {', '.join(rooms)}" for name, rooms in without.items() if rooms)
    return f" Rows that a room lacks are means over the others: {said}." if said else ""


def _row_names(rooms: Sequence[Room]) -> list[str]:
    return list(dict.fromkeys(name for room in rooms for name in room.rows))


def _ours(rooms: Sequence[Room], name: str) -> list[str]:
    """The cells of a row that all the rooms have."""

    def each(of: Callable[[Mapping[str, Any]], T | None]) -> list[T] | None:
        found = [value for room in rooms if (value := of(room.rows[name])) is not None]
        return found if len(found) == len(rooms) else None

    def averaged(of: Callable[[Mapping[str, Any]], float | None], digits: int) -> str:
        values = each(of)
        return NOT_AVAILABLE if values is None else f"{np.mean(values):.{digits}f}"

    def interval(metric: str, digits: int) -> str:
        values = each(lambda row: estimate(row, metric))
        return with_interval(None if values is None else mean(values), digits)

    network = averaged(lambda row: 1e3 * row["network_seconds"], 1)
    low = averaged(lambda row: 1e3 * row["network_seconds_range"][0], 1)
    high = averaged(lambda row: 1e3 * row["network_seconds_range"][1], 1)
    ratios = [room.time_ratio(name) for room in rooms]
    ratio = NOT_AVAILABLE if None in ratios else f"{np.mean([*filter(None, ratios)]):.2f}"
    total = averaged(lambda row: row["frame_seconds"] and 1e3 * row["frame_seconds"]["total"], 1)
    return [
        total, f"{network} ({low} … {high})", ratio, _mse(rooms, name), interval("mssim", 3),
        averaged(lambda row: _of_set(row, "fid", "value"), 1), averaged(lambda row: _of_set(row, "kid", "mean"), 4),
        interval(f"feature_l1_{HEADLINE_BLOCK}", 3),
    ]  # fmt: skip


def _mse(rooms: Sequence[Room], name: str) -> str:
    """The MSE of all seeds."""
    found = [mse for room in rooms if (mse := room.mse(name)) is not None]
    return with_interval(mean(found) if len(found) == len(rooms) else None, 5)


def _of_set(row: Mapping[str, Any], metric: str, key: str) -> float | None:
    """A metric of a set of images, by the key of its value; None where it could not be computed."""
    found = row.get(metric)
    return None if found is None else found[key]


def _theirs(paper: Published | None, unit: Published | None) -> list[str]:
    """The published cells of a row, as many as COLUMNS."""
    if paper is None or unit is None:
        return [""] * len(COLUMNS)
    ratio = f"{paper.seconds / unit.seconds:.2f}"
    errors = f"{paper.mse:.4f}", f"{paper.mssim:.3f}", f"{paper.fid:.1f}"
    return ["", "", ratio, *errors, "", f"{paper.feature_l1:.3f}"]


def mean(estimates: Sequence[Estimate]) -> Estimate:
    """The mean over several rooms of their means, each room alike; each is known as well as its views tell."""
    errors = [each.standard_error for each in estimates if each.standard_error is not None]
    spread = math.hypot(*errors) / len(errors) if len(errors) == len(estimates) else None
    return Estimate(float(np.mean([e.mean for e in estimates])), spread, sum(e.count for e in estimates))


# ---------------------------------------------------------------------------------------------------------- the order


def order_table(rooms: Sequence[Room], published: PublishedTable) -> str:
    """Neighbours in the paper's order, then ours: the gaps there and in each room. Raises SpecError as `Room.gap`."""
    head = ("pair", "paper: gap", *(f"{room.name}: gap (95 %; each seed)" for room in rooms))
    lines = []
    for first, second in (*pairwise(ORDER), *OURS):
        theirs = ""
        if first in published and second in published:
            share = 1 - published[second].mse / published[first].mse
            theirs = f"{share:+.0%} {sign(share)}"
        lines.append([f"`{first}` − `{second}`", theirs, *(_gap(room, first, second) for room in rooms)])
    return markdown_table(head, lines)


def _gap(room: Room, first: str, second: str) -> str:
    gap = room.gap(first, second)
    if gap is None:
        return NOT_AVAILABLE
    interval, share = confidence_interval(gap.difference), gap.difference.mean / gap.unit
    if interval is None:
        return f"{share:+.0%}"
    seeds = ", ".join(f"{of_seed:+.0%}" for of_seed in gap.of_seeds)
    told = f"{share:+.0%} ({interval[0] / gap.unit:+.0%} … {interval[1] / gap.unit:+.0%}; {seeds}) {sign(share)}"
    agree = len({of_seed > 0 for of_seed in gap.of_seeds}) == 1 and (interval[0] > 0 or interval[1] < 0)
    return told if agree else f"{told}, not told apart"


def sign(share: float) -> str:
    """≈ for a small gap, whatever its significance; > where the first's error is larger."""
    return "≈" if abs(share) < CLOSE else ">" if share > 0 else "<"


# ---------------------------------------------------------------------------------------------------------- the rooms


def room_table(rooms: Sequence[Room]) -> str:
    """What each room's figures were measured on, what that cost, and whether the machine was quiet."""
    head = (
        "experiment", "title", "images trained on", "held out", "render of images, core-s", "reference passes",
        "render of passes, core-s", "spp", "connections", "light ratio", "references", "noise of targets, linear MSE",
        "MB in all", "edit, ms", "load average of 1, 5, 15 min", "credits",
    )  # fmt: skip
    return markdown_table(head, [_room_line(room) for room in rooms])


def _room_line(room: Room) -> list[str]:
    card, evaluation = room.document["dataset"], room.document["evaluation"]
    trained_on = sorted({run["trained_on"] for run in room.document["runs"].values()})
    images, passes = room.spent("samples"), room.spent("top-up")
    references, owed = evaluation["references"], card["credits"]
    edit, load = room.document["edit_seconds"], room.document["machine"]["load_average"]
    return [
        room.name, room.document["title"], " or ".join(map(str, trained_on)),
        " or ".join(f"{images['rows'] - count}" for count in reversed(trained_on)), f"{images['core_seconds']:.0f}",
        f"{passes['rows']}", f"{passes['core_seconds']:.0f}", f"{card['spp_per_sample']}",
        f"{card['transport']['connections']}", f"{card['transport']['light_ratio']:g}",
        f"{references['views']} views, {references['spp']} spp" if references else NOT_AVAILABLE,
        f"{evaluation['noise_floor']:.3g}", f"{card['bytes'] / 1e6:.0f}",
        NOT_AVAILABLE if edit is None else f"{1e3 * edit:.0f}",
        ", ".join(f"{average:.1f}" for average in load),
        "" if owed is None else f"“{owed['title']}” by {owed['author']}, {owed['licence']}",
    ]  # fmt: skip


def said(rooms: Sequence[Room], of: Callable[[Room], str]) -> str:
    """What holds of the rooms: once where it is the same of all, or else each with the rooms that it is of."""
    found: dict[str, list[str]] = {}
    for room in rooms:
        found.setdefault(of(room), []).append(room.name)
    if len(found) == 1:
        return next(iter(found))
    return "; ".join(f"{what} ({', '.join(which)})" for what, which in found.items())


# ----------------------------------------------------------------------------------------------------------- the page


def page(found: Sequence[Room], size: SizeName) -> str:
    """All of it as Markdown. Raises SpecError as `Room.gap` does."""
    parts = [f"# The paper's tables over our rooms, `{size}`", introduction(found, size), READING]
    for part, (title, published) in PARTS.items():
        if rooms := [room for room in found if room.experiment.part == part]:
            named = ", ".join(room.name for room in rooms)
            parts.append(f"## {title}\n\nMeans over: {named}.{lacking(rooms)}\n\n{paper_table(rooms, published)}")
            parts.append(f"### Pairs of networks, by MSE\n\n{order_table(rooms, published)}")
            parts.append(f"### The rooms\n\n{room_table(rooms)}")
    parts.append(OF_TIME.format(picture=f"{page_of(size)}.png", table=equal_time.table(found)))
    findings = HERE / "findings.md"
    if size == "small" and findings.is_file():
        parts.append(findings.read_text(encoding="utf-8").strip())
    parts.append(
        f"Timed on {said(found, Room.machine)}. The reports are made by `make experiments-{size}`, this page by "
        f"`{command(size)}`. Taken from their reports at commit "
        f"{said(found, lambda room: str(room.document['commit']))}."
    )
    return "\n\n".join(parts)


def page_of(size: SizeName) -> str:
    """The name of a size's page."""
    return "tables" if size == "small" else f"tables-{size}"


def command(size: SizeName) -> str:
    """What makes the page of the reports."""
    return f"python experiments/tables.py --size {size}"


def introduction(found: Sequence[Room], size: SizeName) -> str:
    """What was run, as the sizes and the reports tell."""
    kinds: dict[str, Callable[[Room], str]] = {
        "networks": lambda room: room.steps(denoisers=False), "denoisers": lambda room: room.steps(denoisers=True)
    }  # fmt: skip
    trained = [
        f"{kind} for {said(having, steps)}"
        for kind, steps in kinds.items()
        if (having := [room for room in found if steps(room)])
    ]
    return (
        f"The size `{size}`: {said(found, lambda room: str(room.document['size']))}. {_resolution(found)} Each row "
        f"of a room is one network (or denoiser), trained on that room's images alone: {', '.join(trained)}. Denoisers "
        "see 1/k of the pixels of one noisy half-estimate."
    )


def _resolution(found: Sequence[Room]) -> str:
    """Whether a GPU took part, and what is at the paper's resolution."""
    films = said(found, lambda room: f"{room.film[0]} × {room.film[1]}")
    at_paper = [room.name for room in found if room.film == room.paper_film]
    if len(at_paper) == len(found):
        reached = "everything"
    else:
        reached = f"of the rooms only {', '.join(at_paper)}" if at_paper else "nothing here"
    size = f"{reached} is at the paper's resolution; images are {films}."
    if any(room.device.startswith("cuda") for room in found):
        return f"A GPU took part: networks ran on {said(found, lambda room: room.device)}; {size}"
    return f"No GPU was at hand: {size}"


READING = f"""\
Errors are against references in the metric space, clip(exposure · I, 0, 1)^(1/2.2); the references' noise is taken
out of MSE and is in all other metrics. MSE of networks is the mean of all their seeds, and all else is the first
seed's. Intervals are over held-out configurations (95 %, Student's t). Two networks are told apart where the interval
of their gap excludes 0 and all seeds agree on its sign. In the tables of pairs ≈ is a gap of less than {CLOSE:.0%} of
the first's error; < and > say whose error is larger. FID is of as few images as there are references, so it can be
compared within this page only. n/a: not measured, or a row that a room lacks.

Time is from the scene to the image on one core, without editing the scene, which all need: each room's table has it
as “edit”. “paper” are the published figures, of four other rooms' average at 256² on the authors' machine. No value
can be compared with ours; of the times only the ratios between networks can. Denoisers' cannot: they depend on the
samples per pixel that are rendered for them, here those of one half, and of small images launching the renderer
costs most."""


OF_TIME = """\
## Error against the time of a frame

![MSE over the time of a frame, room by room]({picture})

Everything is charged: editing the scene, buffers, guides, photons, samples that a denoiser is given, and the network,
on one core. A denoiser is given one half-estimate of each pixel, or of one of so many; between two of a family the
error is taken to follow a power of the time. Below 1 ours is ahead of the best that the family reaches in the same
time. Intervals are a bootstrap over configurations.

{table}"""


def options() -> argparse.ArgumentParser:
    """What can be told."""
    parser = results.parser(__doc__)
    parser.add_argument("--size", choices=get_args(SizeName), default="small")
    parser.add_argument("--work", type=Path, default=results.ROOT / "build/experiments", help="(build/experiments)")
    return parser


def rooms_of(work: Path, size: SizeName, earlier: Path) -> list[Room]:
    """Those that have a report here, and those that an earlier page has.

    Raises IncompleteError where none is, and for what an earlier version has left.
    """
    try:
        documents = json.loads(earlier.read_text(encoding="utf-8"))["rooms"] if earlier.is_file() else {}
    except (ValueError, KeyError, TypeError) as error:
        raise IncompleteError(f"{earlier}: holds no rooms ({error!r}); move it away, and it is made anew") from error
    found = []
    for name in names():
        experiment, report = Experiment.load(name, size), work / name / "report/report.json"
        if report.is_file():
            found.append(Room.read(experiment, report, results.commit()))
        elif name in documents:
            found.append(Room.kept(experiment, documents[name], earlier))
            print(f"{name}: no report in {work}; its rows of {earlier} stay", file=sys.stderr)
    if not found:
        raise IncompleteError(f"{work}: holds no report; `make experiments-{size}` makes them")
    return found


def main() -> int:
    """Write the page; returns the exit code."""
    told = options().parse_args()
    try:
        found = rooms_of(told.work / told.size, told.size, told.out / f"{page_of(told.size)}.json")
        text = page(found, told.size)
    except PhotonfarmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    told.out.mkdir(parents=True, exist_ok=True)
    (told.out / f"{page_of(told.size)}.png").write_bytes(equal_time.picture(found))
    told_of = {
        "command": command(told.size),
        "commit": results.commit(),
        "machine": "each room's own",  # and not the one that this runs on
        "size": told.size,
        "rooms": {room.name: room.document for room in found},
    }
    results.save(page_of(told.size), text, told_of, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
