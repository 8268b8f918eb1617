"""Held-out views in a report: the target, each predictor's image, and its errors [supplement Figs. 6 to 8]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonfarm.shared.core.pictures import Picture, display, display_values
from photonfarm.shared.core.records import F32
from photonfarm.trainer.compare.evaluation_samples import Target
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.worst_cases import caption as worst_view

OVERVIEW = "overview.png"
OVERVIEW_WIDTH = 192  # px, at least, of each picture of it
GAP = 8  # px between them
TITLE = 26  # px, the height of the line above them

LARGEST = 0.25  # difference in the metric space that is drawn brightest


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One predictor's image of a view."""

    name: str
    picture: Picture
    difference: Picture  # |prediction − target| in the metric space, mean of the channels, as colours
    mse: float  # in the metric space, with the target's noise


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One view."""

    caption: str
    target: Picture
    shown: tuple[Shown, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One picture of the report's first row."""

    title: str
    caption: str
    picture: Picture


def rows(contents: ReportContents) -> list[list[Panel]]:
    """Rows of pictures: the first entry's input, output, target and difference, one row for each view, best first."""
    entry = contents.entries[0]
    there = [target for target in contents.evaluation.shown if target.row in entry.row.shown]
    made = [(_shown(entry.name, entry.row.shown[target.row], target.image), target) for target in there]
    made.sort(key=lambda each: each[0].mse)
    return [_panels(contents, shown, target) for shown, target in made]


def first_row(contents: ReportContents) -> list[Panel]:
    """The panels of the view whose error is the median of the shown ones; none if none was measured."""
    found = rows(contents)
    return found[(len(found) - 1) // 2] if found else []


def overview(contents: ReportContents) -> Picture:
    """All rows as one picture with titles above, each pixel enlarged."""
    found = rows(contents)
    lines = [np.concatenate([_framed(panel.picture) for panel in row], axis=1) for row in found]
    sheet = np.concatenate(lines)[:-GAP, :-GAP]
    return np.concatenate([_titles([panel.title for panel in found[0]], sheet.shape[1]), sheet])


def _titles(titles: Sequence[str], width: int) -> Picture:
    """A line of titles, each at the left of its column."""
    from PIL import Image, ImageDraw, ImageFont

    line = Image.new("RGB", (width, TITLE), "white")
    for column, title in enumerate(titles):
        left = column * (width + GAP) // len(titles)
        ImageDraw.Draw(line).text((left, 2), title, "black", ImageFont.load_default(size=16))
    return np.asarray(line)


def _framed(picture: Picture) -> Picture:
    """The picture enlarged, with a white margin to the right and below."""
    scale = max(1, -(-OVERVIEW_WIDTH // picture.shape[1]))
    large = picture.repeat(scale, axis=0).repeat(scale, axis=1)
    framed: Picture = np.pad(large, ((0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return framed


def _panels(contents: ReportContents, shown: Shown, target: Target) -> list[Panel]:
    right = "reference" if target.is_reference else "mean of both halves"
    half_spp = contents.card.spec.transport.half_spp
    return [
        Panel("noisy half", f"noisy half, {half_spp} samples per pixel", display(target.half_a, 1.0)),
        Panel("prediction", f"prediction by {shown.name}", shown.picture),
        Panel(right, f"{right}, {target.spp} samples per pixel", display(target.image, 1.0)),
        Panel("difference", f"difference, MSE {shown.mse:.4f}", shown.difference),
    ]


def cases(contents: ReportContents) -> list[Case]:
    """The first views, then the worst ones."""
    return [_case(contents, target) for target in contents.evaluation.shown]


def legend_of_cases(contents: ReportContents) -> str:
    """The legend of the pictures, in sentences."""
    others = "" if not contents.worst else f", then the worst cases of {contents.entries[0].name}, found automatically"
    return (
        "Shown as clip(exposure · I, 0, 1)^(1/2.2); below each image its difference to the target, from black (0) over "
        f"red to pale yellow ({LARGEST:g} and more), and its MSE against the target as shown, the target's own noise "
        f"left in. The views are the first of the first held-out configurations{others}."
    )


def _case(contents: ReportContents, target: Target) -> Case:
    kinds = [case.kind for case in contents.worst if case.row == target.row]
    what = "reference" if target.is_reference else "noisy target"
    worst = f"{worst_view(kinds)}; " if kinds else ""
    caption = f"{worst}row {target.row}; {what} of {target.spp} samples per pixel"
    images = ((entry.name, entry.row.shown.get(target.row)) for entry in contents.entries)
    shown = tuple(_shown(name, image, target.image) for name, image in images if image is not None)
    return Case(caption, display(target.image, 1.0), shown)


def _shown(name: str, image: F32, target: F32) -> Shown:
    apart = display_values(image) - display_values(target)
    return Shown(name, display(image, 1.0), coloured(np.abs(apart).mean(axis=-1)), float(np.mean(apart**2)))


def coloured(difference: F32) -> Picture:
    """Differences (H, W) as colours (H, W, 3), from black at 0 over red to pale yellow at `LARGEST` and above."""
    import matplotlib as mpl

    shades = mpl.colormaps["magma"](np.clip(difference / LARGEST, 0, 1), bytes=True)
    picture: Picture = np.ascontiguousarray(shades[..., :3])
    return picture
