"""The paper's Tables 1 and 2 over several rooms, with the published figures in columns of their own; pairs of rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from experiments.experiment import name_long
from experiments.rooms import HEADLINE_FEATURE, Room, read_estimate
from photonfarm.core.formatting import format_markdown_table
from photonfarm.core.statistics import Estimate
from photonfarm.trainer.metrics.image_metrics import (
    NOT_AVAILABLE,
    confidence_interval,
    format_with_interval,
)
from photonfarm.trainer.report.contents import Published, PublishedTable

T = TypeVar("T")

UNIT = "light_transport"
"""The row that ratios of times refer to."""

UNPUBLISHED = "–"

ORDER = ("cnn", "feature_projection", UNIT, "light_transport_photons")
OURS = (
    ("feature_projection", "guided_transport"),
    ("cnn", "guided"),
    ("guided", "guided_transport"),
    ("guided_transport", "guided_transport_photons"),
)
"""What ours is compared with: the published network that lacks the same, and itself without a part."""

TRAINED_LONGER = (
    ("cnn", UNIT),
    (UNIT, "guided_transport"),
    ("guided_transport", "guided_denoise"),
    ("denoise_1_reflectance", "guided_denoise"),
)
"""What is compared of the networks that were trained for longer."""

CLOSE = 0.1  # ≈: a gap of less than this share of the first's error


# ------------------------------------------------------------------------------------------------------------ columns


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its head, its cell in some rooms' row of a name, and the published figure, given its row and UNIT's."""

    head: str
    ours: Callable[[Sequence[Room], str], str]
    theirs: Callable[[Published, Published], str] | None = None


def _collect(rooms: Sequence[Room], name: str, of: Callable[[Mapping[str, Any]], T | None]) -> list[T] | None:
    """A value of each room's row; None where one lacks it."""
    values = [value for room in rooms if (value := of(room.rows[name])) is not None]
    return values if len(values) == len(rooms) else None


def _average(of: Callable[[Mapping[str, Any]], float | None], digits: int) -> Callable[[Sequence[Room], str], str]:
    def cell(rooms: Sequence[Room], name: str) -> str:
        values = _collect(rooms, name, of)
        return NOT_AVAILABLE if values is None else f"{np.mean(values):.{digits}f}"

    return cell


def _format_interval(metric: str, digits: int) -> Callable[[Sequence[Room], str], str]:
    def cell(rooms: Sequence[Room], name: str) -> str:
        values = _collect(rooms, name, lambda row: read_estimate(row, metric))
        return format_with_interval(None if values is None else average(values), digits)

    return cell


def _format_set(metric: str, key: str) -> Callable[[Mapping[str, Any]], float | None]:
    """A function to a metric of a set of images, by the key of its value; None where it could not be computed."""
    return lambda row: row[metric][key] if row.get(metric) is not None else None


def _format_mse(rooms: Sequence[Room], name: str) -> str:
    """The MSE of all seeds."""
    errors = [mse for room in rooms if (mse := room.mse(name)) is not None]
    return format_with_interval(average(errors) if len(errors) == len(rooms) else None, 5)


def _format_network_time(rooms: Sequence[Room], name: str) -> str:
    """The time of the network alone, and its range."""
    middle = _average(lambda row: 1e3 * row["network_seconds"], 1)(rooms, name)
    low = _average(lambda row: 1e3 * row["network_seconds_range"][0], 1)(rooms, name)
    high = _average(lambda row: 1e3 * row["network_seconds_range"][1], 1)(rooms, name)
    return f"{middle} ({low} … {high})"


def _format_time_ratio(rooms: Sequence[Room], name: str) -> str:
    ratios = [room.time_ratio(name) for room in rooms]
    return NOT_AVAILABLE if None in ratios else f"{np.mean([*filter(None, ratios)]):.2f}"


def average(estimates: Sequence[Estimate]) -> Estimate:
    """The mean over several rooms of their means, each room alike; each with the standard error over its views."""
    errors = [each.standard_error for each in estimates if each.standard_error is not None]
    spread = math.hypot(*errors) / len(errors) if len(errors) == len(estimates) else None
    return Estimate(float(np.mean([e.mean for e in estimates])), spread, sum(e.count for e in estimates))


# ------------------------------------------------------------------------------------------------------------- tables

ERRORS = (
    Column("ms a frame", _average(lambda row: row["frame_seconds"] and 1e3 * row["frame_seconds"]["total"], 1)),
    Column("MSE (95 %)", _format_mse, lambda paper, _: f"{paper.mse:.4f}"),
    Column("MSSIM (95 %)", _format_interval("mssim", 3), lambda paper, _: f"{paper.mssim:.3f}"),
)
FURTHER = (
    Column("network alone, ms (range)", _format_network_time),
    Column(f"× {UNIT}", _format_time_ratio, lambda paper, unit: f"{paper.seconds / unit.seconds:.2f}"),
    Column("FID", _average(_format_set("fid", "value"), 1), lambda paper, _: f"{paper.fid:.1f}"),
    Column("KID", _average(_format_set("kid", "mean"), 4)),
    Column(
        "Feature L1 (95 %)",
        _format_interval(HEADLINE_FEATURE, 3),
        lambda paper, _: f"{paper.feature_l1:.3f}",
    ),
)


def format_errors(rooms: Sequence[Room], published: PublishedTable) -> str:
    """The time of a frame and its errors, each a mean over the rooms that have the row. Raises SpecError."""
    return _format_table(rooms, published, ERRORS)


def format_further_metrics(rooms: Sequence[Room], published: PublishedTable) -> str:
    """Times of networks and metrics of features, each a mean over the rooms that have the row."""
    return _format_table(rooms, published, FURTHER)


def _format_table(rooms: Sequence[Room], published: PublishedTable, columns: Sequence[Column]) -> str:
    """A row for each predictor, without columns that no row has; behind a column that the paper has, its figures."""
    names = _list_row_names(rooms)
    having = {name: [room for room in rooms if name in room.rows] for name in names}
    columns = [each for each in columns if any(each.ours(having[name], name) != NOT_AVAILABLE for name in names)]
    head = ["architecture"]
    for column in columns:
        head.append(column.head)
        if published and column.theirs:
            head.append(f"paper: {column.head.removesuffix(' (95 %)')}")
    return format_markdown_table(head, [_format_line(having[name], name, published, columns) for name in names])


def _format_line(having: Sequence[Room], name: str, published: PublishedTable, columns: Sequence[Column]) -> list[str]:
    line, paper = [name], published.get(name)
    for column in columns:
        line.append(column.ours(having, name))
        if published and column.theirs:
            line.append(column.theirs(paper, published[UNIT]) if paper else UNPUBLISHED)
    return line


def describe_lacking(rooms: Sequence[Room]) -> str:
    """Which rows are no mean over all rooms, a sentence; empty where all are."""
    without = {name: [room.name for room in rooms if name not in room.rows] for name in _list_row_names(rooms)}
    said = "; ".join(f"{name} without {', '.join(rooms)}" for name, rooms in without.items() if rooms)
    return f" Rows that a room lacks are means over the others: {said}." if said else ""


def _list_row_names(rooms: Sequence[Room]) -> list[str]:
    """Those of the tables: of what comes ready, only where it is given one half of all pixels."""
    names = dict.fromkeys(name for room in rooms for name in room.rows)
    return [name for name in names if " " not in name or name.endswith(" 1/1")]


# -------------------------------------------------------------------------------------------------------------- pairs


def format_orders(rooms: Sequence[Room], published: PublishedTable) -> str:
    """Neighbours in the paper's order, ours, and longer runs: their gaps, and ours. Raises SpecError as `Room.gap`."""
    head = ("pair", *(["paper"] if published else []), *(room.name for room in rooms))
    lines = []
    long = rooms[0].experiment.size.long
    longer = [[name_long(name, long.steps) for name in pair] for pair in TRAINED_LONGER] if long else []
    known = [pair for pair in longer if any({*pair} <= {*room.rows} for room in rooms)]
    for first, second in (*pairwise(ORDER), *OURS, *known):
        theirs = UNPUBLISHED
        if first in published and second in published:
            share = 1 - published[second].mse / published[first].mse
            theirs = f"{share:+.0%} {choose_sign(share)}"
        paper = [theirs] if published else []
        lines.append([f"`{first}` − `{second}`", *paper, *(format_gap(room, first, second) for room in rooms)])
    return format_markdown_table(head, lines)


def format_gap(room: Room, first: str, second: str) -> str:
    """How far the first's MSE is above the second's, as a share of it. Raises SpecError as `Room.gap`."""
    pair = room.gap(first, second)
    if pair is None:
        return NOT_AVAILABLE
    interval, share = confidence_interval(pair.difference), pair.difference.mean / pair.unit
    if interval is None:
        return f"{share:+.0%}"
    seeds = ", ".join(f"{of_seed:+.0%}" for of_seed in pair.of_seeds)
    text = (
        f"{share:+.0%} ({interval[0] / pair.unit:+.0%} … {interval[1] / pair.unit:+.0%}; {seeds}) {choose_sign(share)}"
    )
    agree = len({of_seed > 0 for of_seed in pair.of_seeds}) == 1 and (interval[0] > 0 or interval[1] < 0)
    return text if agree else f"{text}, not told apart"


def choose_sign(share: float) -> str:
    """≈ for a small gap, whatever its significance; > where the first's error is larger."""
    return "≈" if abs(share) < CLOSE else ">" if share > 0 else "<"
