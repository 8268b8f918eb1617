#!/usr/bin/env python3
"""Puts the reports of experiments together: the paper's Tables 1 and 2 over our rooms, and what agrees with them.

    python experiments/tables.py [--size small] [--work build/experiments] [--out docs/results]

Reads WORK/SIZE/NAME/report/report.json of every experiment that has one, and leaves tables.md and tables.json. What was
found out beyond the figures stands in experiments/findings.md, which becomes the page's last part. Exit code 0, or 7
where no report is there.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np

from experiment import HERE, Experiment, SizeName, names
from photonfarm.shared.errors import IncompleteError
from photonfarm.shared.estimate import Estimate
from photonfarm.trainer.markdown import markdown_table
from photonfarm.trainer.metrics import confidence_interval
from photonfarm.trainer.report.published import FIXED_LIGHTS, MOVABLE_LIGHTS, Table
from photonfarm.trainer.report.tables import with_interval

ROOT = HERE.parent
sys.path.insert(0, str(ROOT / "bench"))
import results  # noqa: E402

KINDS = {"movable": ("Table 2: movable objects and lights", MOVABLE_LIGHTS)}
KINDS |= {"fixed": ("Table 1: movable objects, fixed lights", FIXED_LIGHTS), "static": ("Static rooms", {})}
ORDER = ("cnn", "feature_projection", "light_transport", "light_transport_photons")
CLOSE = 0.1  # ≈: a gap of less than this share of the first's error


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """An experiment's report."""

    name: str  # of the experiment
    report: dict[str, Any]

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        """Those of its evaluation, by name."""
        return {row["name"]: row for row in self.report["evaluation"]["rows"]}

    def document(self) -> dict[str, Any]:
        """What tables.json keeps of it."""
        evaluation = self.report["evaluation"]
        kept = {key: evaluation[key] for key in ("samples", "units", "noise_floor", "references", "device", "threads")}
        runs = {
            run["name"]: {key: run[key] for key in ("parameters", "steps", "seconds")} for run in self.report["runs"]
        }
        rows = {name: _compact(row) for name, row in self.rows.items()}
        return {"dataset": self.report["dataset"], "evaluation": kept, "runs": runs, "rows": rows}

    def metric(self, architecture: str, metric: str, block: int | None = None) -> Estimate:
        """Mean and standard error of a metric that each image has."""
        found = self.rows[architecture]["metric_space"][metric]
        found = found if block is None else found[block]
        return Estimate(**found["estimate"])

    def gap(self, first: str, second: str) -> Estimate:
        """By how much the first's MSE is above the second's, in pairs of views; each view is a configuration."""
        values = [np.array(self.rows[name]["metric_space"]["mse"]["values"]) for name in (first, second)]
        return Estimate.of(values[0] - values[1])


def _compact(row: dict[str, Any]) -> dict[str, Any]:
    """Time, mean and interval of each metric, and the MSE of each image."""
    shown, linear = row["metric_space"], row["linear_mse"]
    metrics = {key: shown[key]["estimate"] for key in ("mse", "mssim", "flip")}
    metrics |= {f"feature_l1_{block}": of["estimate"] for block, of in enumerate(shown["feature_l1"] or ())}
    metrics |= {key: shown[key] for key in ("fid", "kid", "inception")}
    return {
        "frame_seconds": row["frame_seconds"],
        "linear_mse": {key: linear[key] for key in ("mean", "standard_error", "count")},
        "mse_of_images": [round(value, 6) for value in shown["mse"]["values"]],
        **metrics,
    }


def mean(estimates: Sequence[Estimate]) -> Estimate:
    """Of several rooms, each alike: the mean of their means, of which each room is known as well as its views tell."""
    spread = math.sqrt(sum((each.standard_error or 0) ** 2 for each in estimates)) / len(estimates)
    return Estimate(float(np.mean([e.mean for e in estimates])), spread, sum(e.count for e in estimates))


def paper_table(rooms: list[Room], published: Table) -> str:
    """The paper's columns, each a mean over the rooms; the published figure beside each."""
    head = (
        "architecture", "time per frame, ms", "× light transport", "paper", "MSE (95 %)", "paper", "MSSIM (95 %)",
        "paper", "FID", "paper", "KID", "Feature L1 (95 %)", "paper",
    )  # fmt: skip
    lines = []
    for name in rooms[0].rows:
        if not all(name in room.rows for room in rooms):
            continue
        paper = published.get(name)
        unit = published.get("light_transport")
        seconds, ratio = _times(rooms, name)
        sets = [np.mean([room.rows[name]["metric_space"][m][key] for room in rooms]) for m, key in SETS]
        lines.append([
            name, seconds, ratio, f"{paper.seconds / unit.seconds:.2f}" if paper and unit else "",
            with_interval(mean([room.metric(name, "mse") for room in rooms]), 5), f"{paper.mse:.4f}" if paper else "",
            with_interval(mean([room.metric(name, "mssim") for room in rooms]), 3),
            f"{paper.mssim:.3f}" if paper else "",
            f"{sets[0]:.1f}", f"{paper.fid:.1f}" if paper else "", f"{sets[1]:.4f}",
            with_interval(mean([room.metric(name, "feature_l1", 3) for room in rooms]), 3),
            f"{paper.feature_l1:.3f}" if paper else "",
        ])  # fmt: skip
    return markdown_table(head, lines)


SETS = (("fid", "value"), ("kid", "mean"))
"""Metrics of sets of images, and the key of their value."""


def _times(rooms: list[Room], name: str) -> tuple[str, str]:
    """Milliseconds of a frame, and their ratio to light_transport's, means over rooms."""
    frames = [(room.rows[name]["frame_seconds"], room.rows["light_transport"]["frame_seconds"]) for room in rooms]
    if any(own is None for own, _ in frames):
        return "n/a", "n/a"
    ratio = np.mean([own["total"] / unit["total"] for own, unit in frames])
    return f"{1e3 * np.mean([own['total'] for own, _ in frames]):.1f}", f"{ratio:.2f}"


def order_table(rooms: list[Room], published: Table) -> str:
    """Neighbours in the paper's order: their gaps there, and in each room."""
    head = ("pair", "paper: gap", *(f"{room.name}: gap (95 %)" for room in rooms))
    lines = []
    for first, second in pairwise(ORDER):
        theirs = ""
        if published:
            share = 1 - published[second].mse / published[first].mse
            theirs = f"{share:+.0%} {sign(share)}"
        lines.append([f"`{first}` − `{second}`", theirs, *(_gap(room, first, second) for room in rooms)])
    return markdown_table(head, lines)


def _gap(room: Room, first: str, second: str) -> str:
    gap, unit = room.gap(first, second), room.metric(first, "mse").mean
    interval = confidence_interval(gap)
    share = gap.mean / unit
    if interval is None:
        return f"{share:+.0%}"
    known = "" if interval[0] > 0 or interval[1] < 0 else ", not told apart"
    return f"{share:+.0%} ({interval[0] / unit:+.0%} … {interval[1] / unit:+.0%}) {sign(share)}{known}"


def sign(share: float) -> str:
    """≈ for a small gap, whatever its significance; > where the first's error is larger."""
    return "≈" if abs(share) < CLOSE else ">" if share > 0 else "<"


def room_table(rooms: list[Room]) -> str:
    """What each room's figures were measured on."""
    head = ("experiment", "images", "spp", "references", "noise floor", "render, core-s", "MB", "credits")
    lines = []
    for room in rooms:
        card, evaluation = room.report["dataset"], room.report["evaluation"]
        owed = card["credits"]
        references = evaluation["references"]
        lines.append([
            room.name, f"{card['samples_complete']}", f"{card['spp_per_sample']}",
            f"{references['views']} views, {references['spp']} spp", f"{evaluation['noise_floor']:.3g}",
            f"{card['core_seconds']:.0f}", f"{card['bytes'] / 1e6:.0f}",
            "" if owed is None else f"“{owed['title']}” by {owed['author']}, {owed['licence']}",
        ])  # fmt: skip
    return markdown_table(head, lines)


def page(found: list[Room], size: SizeName) -> str:
    """All of it as Markdown."""
    parts = [f"# The paper's tables over our rooms, `{size}`\n\n{INTRODUCTION}"]
    for kind, (title, published) in KINDS.items():
        if rooms := [room for room in found if room.name.startswith(kind)]:
            named = ", ".join(room.name for room in rooms)
            parts.append(f"## {title}\n\nMeans over: {named}.\n\n{paper_table(rooms, published)}")
            parts.append(f"### Neighbours in the paper's order, by MSE\n\n{order_table(rooms, published)}")
            parts.append(f"### The rooms\n\n{room_table(rooms)}")
    findings = HERE / "findings.md"
    if findings.is_file():
        parts.append(findings.read_text().strip())
    parts.append(f"Made by `make experiments-{size}` and `python experiments/tables.py --size {size}`; "
                 f"{results.footer('tables').removeprefix('Made by `make bench-tables` ')}")  # fmt: skip
    return "\n\n".join(parts)


INTRODUCTION = """\
Each row of a room is one network (or denoiser), trained from one seed on that room's images alone, at the size that
experiments/sizes.toml states; denoisers see 1/k of the pixels of one noisy half-estimate. Errors are against references
in the metric space, clip(exposure · I, 0, 1)^(1/2.2); the references' noise is taken out of MSE and is in all other
metrics. Intervals are over held-out configurations (95 %, Student's t): they hold for these networks, another seed's
may lie outside. FID is of as few images as there are references, so it can be compared within this page only. Time is
from the scene to the image on one core. “paper” are the published figures, of four other rooms' average at 256²: orders
and ratios can be compared, values cannot."""


def options() -> argparse.ArgumentParser:
    """What can be told."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=get_args(SizeName), default="small")
    parser.add_argument("--work", type=Path, default=ROOT / "build/experiments", help="(build/experiments)")
    results.add_options(parser)
    return parser


def main() -> int:
    """Write the page; returns the exit code."""
    told = options().parse_args()
    files = {name: told.work / told.size / name / "report/report.json" for name in names()}
    found = [Room(name, json.loads(file.read_text())) for name, file in files.items() if file.is_file()]
    if not found:
        print(f"{told.work / told.size}: holds no report; `make experiments-{told.size}` makes them", file=sys.stderr)
        return IncompleteError.exit_code
    about = {name: Experiment.load(name, told.size).about.strip() for name in (room.name for room in found)}
    rooms = {room.name: {"about": about[room.name], **room.document()} for room in found}
    results.write("tables", page(found, told.size), {"size": told.size, "rooms": rooms}, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
