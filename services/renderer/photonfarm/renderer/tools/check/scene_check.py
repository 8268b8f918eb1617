"""`photonfarm scene check`: a scene is loaded once, measured, drawn and rendered, and its spec compared with that.

What was found is a page (HTML), one file that needs no other.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import store_errors
from photonfarm.core.page import render_page
from photonfarm.core.pictures import Picture, display_values
from photonfarm.core.records import F32
from photonfarm.core.waiting import Log, WorkLog
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.check import drawings, samples, shape_pictures
from photonfarm.renderer.tools.check.drawings import COLOURS, Drawing
from photonfarm.renderer.tools.check.findings import (
    CUT_AT_ALL,
    INSIDE,
    LEAST_SEEN,
    MEANS,
    OUTSIDE,
    Finding,
    Measured,
    collect_findings,
    percent,
)
from photonfarm.renderer.tools.check.shapes import ShapeFacts, facts_of, groups_by_shape, placements
from photonfarm.renderer.tools.measure.exposure import TARGET
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec, SpecLines

TEMPLATE = Path(__file__).with_name("check.html.j2")

BINS = 32

PICTURED = 240
"""The most shapes that get a picture: those of movable groups, and then the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneCheck:
    """All that a check found."""

    spec: SceneSpec
    shapes: list[ShapeFacts]
    pictures: dict[int, Picture]  # of some shapes, by their number
    room: F32  # (2, 3) the box of what does not move
    measured: Measured
    drawings: list[Drawing]
    findings: list[Finding]
    seconds: float


def check(named: NamedSpec, log: Log) -> SceneCheck:
    """Check a spec; the backend must have been loaded. Raises SpecError and BackendError as loading does."""
    with WorkLog(log) as work:
        return _check(named, work)


def _check(named: NamedSpec, work: WorkLog) -> SceneCheck:
    begun, spec = time.monotonic(), named.spec
    work.begin(f"loading {spec.name}")
    scene = LoadedScene.load(samples.small(spec), named.file.parent)
    group_of = groups_by_shape(spec)
    shapes = facts_of(scene.scene, group_of)
    boxes, still = scene.boxes, scene.still
    room = _around(boxes[still] if still.any() else boxes)
    work.begin(f"{len(shapes)} shapes; drawing them, and moving groups to {len(spec.groups)} boxes' ends")
    geometry, cloud = scene.base()
    placed = placements(scene, geometry)
    colours = shape_pictures.shape_colours(scene.scene, geometry)
    drawn = drawings.drawings(scene.scene, spec, geometry, colours, placed, room)
    up = int(np.abs(spec.view.up).argmax())
    pictured = _choose_pictured(shapes, boxes)
    pictures = {number: shape_pictures.draw_from_corner(geometry, number, colours[number], up) for number in pictured}
    rendered = samples.render(scene, spec, cloud, work)
    low, high = _around(boxes)
    measured = Measured(low, high, placed, rendered)
    findings = collect_findings(spec, named.lights, measured)
    return SceneCheck(spec, shapes, pictures, room, measured, drawn, findings, time.monotonic() - begun)


def _around(boxes: F32) -> F32:
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def _choose_pictured(shapes: list[ShapeFacts], boxes: F32) -> list[int]:
    """The numbers of the shapes that get a picture."""
    size = np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)
    order = sorted(range(len(shapes)), key=lambda number: (shapes[number].group is None, -size[number]))
    return order[:PICTURED]


@dataclass(frozen=True, slots=True)
class Fact:
    """A number with what it says."""

    name: str
    value: str
    note: str = ""
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class Tile:
    """A shape with its picture, if it has one, and its place in the plan."""

    shape: ShapeFacts
    picture: Picture | None
    place: tuple[float, float, float, float]  # x, y, width and height of its box in a plan of 1 × 1


def write(check: SceneCheck, lines: SpecLines, out: Path) -> None:
    """Write the page of a check to a file; raises StoreError where that cannot be."""
    with store_errors("write the page", out):
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page(check, lines), encoding="utf-8")


def page(check: SceneCheck, lines: SpecLines) -> str:
    """The page."""
    spec, seen = check.spec, check.measured.samples
    groups = [
        (group, COLOURS[number % len(COLOURS)], placed)
        for number, (group, placed) in enumerate(zip(spec.groups, check.measured.placed, strict=True))
    ]
    shown = [
        (each, [g.name for g, there in zip(spec.groups, each.modification.present, strict=True) if not there])
        for each in seen.shown
    ]
    exposed = spec.exposure * np.nan_to_num(seen.images.halves.mean(axis=1))
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {spec.name}",
        check=check,
        spec=spec,
        file=lines.file.name,
        findings=[(finding, lines.line(finding.key)) for finding in check.findings],
        groups=groups,
        shown=shown,
        cameras=_camera_facts(check),
        light=_light_facts(check),
        seen=_bars(seen.cameras.seen, (0.0, float(max(seen.cameras.seen.max(), 1e-6)))),
        brightness=_bars(display_values(exposed.astype(np.float32)).mean(axis=-1), (0.0, 1.0)),
        most_seen=f"{100 * float(seen.cameras.seen.max()):.0f} %",
        sections=_sections(check),
        limits={"outside": OUTSIDE, "cut": CUT_AT_ALL},
    )


def _camera_facts(check: SceneCheck) -> list[Fact]:
    cameras, points = check.measured.samples.cameras, check.spec.points
    holders = ", ".join(name for name, _ in cameras.holders()[:3])
    median, low = np.percentile(cameras.seen, [50, 5])
    return [
        Fact("stand inside objects", percent(cameras.inside_share), holders, cameras.inside_share >= INSIDE),
        Fact("look through a wall from outside", percent(cameras.behind.mean()), "", bool(cameras.behind.any())),
        Fact("see no surface", percent(cameras.nothing.mean()), "", bool(cameras.nothing.any())),
        Fact(
            "points that a view sees",
            f"{median * points:.0f} of {points}",
            f"5 % of views: below {low * points:.0f}",
            bool(low < LEAST_SEEN),
        ),
    ]


def _light_facts(check: SceneCheck) -> list[Fact]:
    images = check.measured.samples.images
    mean = float(images.display_means(check.spec.exposure).mean())
    better = images.exposure(TARGET)
    note = "" if better is None else f"{TARGET:g} at exposure {better:.2g}"
    return [Fact("display mean", f"{mean:.2f}", note, not MEANS[0] <= mean <= MEANS[1])]


def _bars(values: NDArray[Any], ends: tuple[float, float]) -> list[float]:
    """A histogram's bars, of height 1 at most."""
    counts, _ = np.histogram(np.clip(values, *ends), BINS, ends)
    return [float(count) for count in counts / max(counts.max(), 1)]


def _sections(check: SceneCheck) -> list[tuple[str, list[Tile], list[Tile]]]:
    """Shapes by movable group, and then those that do not move: with pictures, and without."""
    names = [group.name for group in check.spec.groups]
    order = sorted(range(len(check.shapes)), key=lambda number: _place(check.shapes[number], names))
    sections = []
    for name, numbers in groupby(order, key=lambda number: check.shapes[number].group):
        tiles = [_tile(check, number) for number in numbers]
        with_picture = [tile for tile in tiles if tile.picture is not None]
        sections.append((name or "", with_picture, [tile for tile in tiles if tile.picture is None]))
    return sections


def _place(shape: ShapeFacts, names: Sequence[str]) -> int:
    return len(names) if shape.group is None else names.index(shape.group)


def _tile(check: SceneCheck, number: int) -> Tile:
    shape, up = check.shapes[number], int(np.abs(check.spec.view.up).argmax())
    across, along = (axis for axis in range(3) if axis != up)
    low, size = check.room[0], np.maximum(check.room[1] - check.room[0], 1e-9)
    corners = (np.array([shape.min, shape.max]) - low) / size
    (x0, y0), (x1, y1) = np.clip(corners[:, [across, along]], 0, 1)
    return Tile(shape, check.pictures.get(number), (float(x0), float(y0), float(x1 - x0), float(y1 - y0)))
