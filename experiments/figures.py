#!/usr/bin/env python3
"""Puts pictures of the experiments' reports together, as the supplement's Figures 3 to 8 show them.

    python experiments/figures.py [--rooms NAME ...] [--work build/experiments/small] [--out docs/results/figures]

Reads WORK/NAME/report/ of experiments that have run. Of each static room it leaves NAME.png: reference, prediction and
difference [S Figs. 3, 4]. Of the others it leaves NAME-predictions.png, predictions of several networks above their
errors [S Fig. 7]; and NAME-worst.png, the worst views [S Fig. 8]. Error over the time of a frame [S Figs. 5, 6] is
drawn by tables.py. Exit code 0, or 7 for a room that has not run.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from experiments.experiment import HERE, Experiment
from photonfarm.core.errors import IncompleteError
from photonfarm.core.pictures import GAP, LINE, Picture, draw_sheet
from photonfarm.trainer.compare.evaluation_page import COMPARISON
from photonfarm.trainer.report.views import colour_difference
from photonfarm.trainer.report.worst_cases import name_kinds

ROOMS = [
    "static-bathroom",
    "static-kitchen",
    "night-living-room-2",
    "movable-veach-ajar",
    "fixed-living-room",
    "fixed-veach-ajar",
]
OURS = ("guided_transport-4000", "guided_denoise-4000")
PUBLISHED = "light_transport-4000"
COMPARED = ("oidn-reflectance 1/1", PUBLISHED, *OURS, "denoise_1_reflectance-4000")
"""What is shown beside the reference: a denoiser that comes ready, the published network, ours, and one of the room."""

VIEWS = 3  # at most, of the first ones
SIZE = 256  # px of a tile
COLOURS = 256  # of a figure, which takes a third of the bytes so
TEXT = 24  # px of letters
REFERENCE = "reference"


class Report:
    """The pictures of a report: a tile (H, W, 3) for each predictor and each view that it shows, by the view's row."""

    def __init__(self, folder: Path) -> None:
        """Raises IncompleteError where there is no report."""
        self.folder = folder
        if not (folder / "report.json").is_file():
            raise IncompleteError(f"{folder}: holds no report; `make experiments-small` makes it")
        document = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        shown = document["evaluation"]["shown"]
        names = [REFERENCE, *(row["name"] for row in document["evaluation"]["rows"] if row.get("halves", 1) == 1)]
        sheet = np.asarray(Image.open(folder / COMPARISON))
        width = (sheet.shape[1] + GAP) // len(names) - GAP
        step = width + LINE + GAP
        top = sheet.shape[0] + GAP - len(shown) * step + LINE
        self.tiles = {
            name: {
                row: _make_tile(sheet, top + place * step, column * (width + GAP), width)
                for place, row in enumerate(shown)
            }
            for column, name in enumerate(names)
        }
        self.first: list[int] = shown[:VIEWS]
        """Rows of the first views that are held out."""
        self.worst: dict[int, list[str]] = {}
        """Rows of the worst views, each with the kinds of pixels that it is the worst of."""
        for case in document["worst_cases"]:
            self.worst.setdefault(case["row"], []).append(case["kind"])


def _make_tile(sheet: Picture, y: int, x: int, size: int) -> Picture:
    tile = Image.fromarray(sheet[y : y + size, x : x + size]).resize((SIZE, SIZE), Image.Resampling.NEAREST)
    return np.asarray(tile)


def draw_error(tile: Picture, reference: Picture) -> Picture:
    """|prediction − reference| as shown, the mean of the channels, as colours."""
    apart: NDArray[np.float32] = np.abs(tile.astype(np.float32) - reference).mean(axis=-1) / np.float32(255)
    return colour_difference(apart)


def draw_predictions(report: Report, names: list[str]) -> Picture:
    """A column for the reference and one for each of some networks, with the error below each image."""
    blank = np.full((SIZE, SIZE, 3), 255, np.uint8)
    rows = []
    for view in report.first:
        reference, *shown = (report.tiles[name][view] for name in (REFERENCE, *names))
        rows.append([reference, *shown])
        rows.append([blank, *(draw_error(tile, reference) for tile in shown)])
    return draw_sheet([REFERENCE, *names], rows, [""] * len(rows), TEXT)


def draw_worst_cases(report: Report) -> Picture:
    """The worst views: reference, the published network and ours, each with its error."""
    names = (PUBLISHED, *OURS)
    rows = []
    for view in report.worst:
        reference, *shown = (report.tiles[name][view] for name in (REFERENCE, *names))
        rows.append([reference, *(tile for each in shown for tile in (each, draw_error(each, reference)))])
    captions = [name_kinds(kinds) for kinds in report.worst.values()]
    return draw_sheet([REFERENCE, *(head for name in names for head in (name, "its error"))], rows, captions, TEXT)


def make_figures(name: str, report: Report, out: Path) -> None:
    """The figures of one room. Raises IncompleteError where its report lacks a network that they show."""
    if lacking := {PUBLISHED, *OURS} - {*report.tiles}:
        raise IncompleteError(f"{report.folder}: lacks {', '.join(sorted(lacking))}; `make experiments-small` adds it")
    if Experiment.load(name, "small").part == "static":
        save(draw_predictions(report, [OURS[0]]), out / f"{name}.png")
        return
    compared = [name for name in COMPARED if name in report.tiles]
    save(draw_predictions(report, compared), out / f"{name}-predictions.png")
    save(draw_worst_cases(report), out / f"{name}-worst.png")


def save(figure: Picture, path: Path) -> None:
    """Write a PNG of few colours: small, as the documentation keeps it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(figure).quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> int:
    """Make the figures of all rooms; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="(%(default)s)")
    parser.add_argument("--work", type=Path, default=HERE.parent / "build/experiments/small")
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs/results/figures")
    told = parser.parse_args()
    code = 0
    for name in told.rooms:
        try:
            make_figures(name, Report(told.work / name / "report"), told.out)
        except IncompleteError as error_:
            print(f"error: {error_}", file=sys.stderr)
            code = IncompleteError.exit_code
    return code


if __name__ == "__main__":
    sys.exit(main())
