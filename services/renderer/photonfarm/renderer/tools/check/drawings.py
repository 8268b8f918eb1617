"""Plan and elevation: an orthographic picture, and over it the boxes of the spec and the outlines of what they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.pictures import Picture
from photonfarm.core.records import F32, Geometry
from photonfarm.renderer.tools.check.shape_pictures import Projection, draw_scene
from photonfarm.renderer.tools.check.shapes import Placed, group_vertices
from photonfarm.scene.spec import Box, SceneSpec

WIDTH = 400
"""The width of a drawing in its own units, in which a letter is about `LETTER` wide and a line `LINE` high."""

PIXELS = 640
LETTER, LINE = 4.9, 10.0
EXTREMES = 48
"""The directions in which an outline is looked for."""

COLOURS = (
    "#1b66c9",
    "#c62828",
    "#1f8a3b",
    "#7b3fb5",
    "#d96a00",
    "#00838f",
    "#b5267e",
    "#6d4c41",
    "#8a8a00",
    "#455a64",
)
"""The colours of movable groups, in turn."""


@dataclass(frozen=True, slots=True)
class Mark:
    """What is drawn of one group, or of one box of views."""

    name: str
    colour: str
    kind: str  # "object", "light", "cameras" or "looked at"
    box: str  # the path of its box of positions
    outline: str  # the path around its shapes at rest; empty for views
    at: tuple[float, float] | None  # where its reference point is
    label: tuple[float, float]  # where its name begins


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One drawing."""

    title: str
    picture: Picture
    height: float
    marks: list[Mark]
    bar: float  # the length of the scale bar in the drawing's units
    bar_name: str  # and in those of the scene


def drawings(
    scene: Any, spec: SceneSpec, geometry: Geometry, colours: F32, placed: Sequence[Placed], room: NDArray[Any]
) -> list[Drawing]:
    """The plan and the elevation of a scene at rest; `room` (2, 3) is the box of what does not move."""
    upwards = np.array(spec.view.up)
    across = np.eye(3)[0 if upwards[0] == 0 else 1]
    low, high = _extent(spec, placed, room)
    boxes = np.array([spec.view.origin.low, spec.view.origin.high, spec.view.look_at.low, spec.view.look_at.high])
    sheets = []
    for title, down in (("Plan", np.cross(-upwards, across)), ("Elevation", -upwards)):
        start = float((boxes @ np.cross(across, down)).min())
        projection = Projection.around(across, down, low, high, start)
        sheets.append(_drawing(title, scene, spec, geometry, colours, projection))
    return sheets


def _extent(spec: SceneSpec, placed: Sequence[Placed], room: NDArray[Any]) -> NDArray[np.float64]:
    """The box (2, 3) to draw: all boxes with what stands in them, and the room as far as it is near to them."""
    low, high = (
        np.array([[*getattr(box, end)] for box in (spec.view.origin, spec.view.look_at, *placed)])
        for end in ("low", "high")
    )
    core = np.array([low.min(axis=0), high.max(axis=0)])
    reach = 0.6 * (core[1] - core[0]).max()
    near = np.array([np.maximum(room[0], core[0] - reach), np.minimum(room[1], core[1] + reach)])
    moved = [
        np.array([each.low, each.high]) + np.array([group.box.low, group.box.high]) - np.array(group.at)
        for group, each in zip(spec.groups, placed, strict=True)
    ]
    everything = np.array([core, near, *moved])
    low, high = everything[:, 0].min(axis=0), everything[:, 1].max(axis=0)
    margin = 0.03 * (high - low).max()
    return np.array([low - margin, high + margin])


def _drawing(
    title: str, scene: Any, spec: SceneSpec, geometry: Geometry, colours: F32, projection: Projection
) -> Drawing:
    height = WIDTH * projection.size[1] / projection.size[0]
    marks = [
        _mark(name, "#111", kind, box, projection)
        for name, kind, box in (("origin", "cameras", spec.view.origin), ("look_at", "looked at", spec.view.look_at))
    ]
    for number, group in enumerate(spec.groups):
        vertices = group_vertices(geometry, number)
        kind = "object" if number < len(spec.objects) else "light"
        colour = COLOURS[number % len(COLOURS)]
        marks.append(_mark(group.name, colour, kind, group.box, projection, np.array(group.at), vertices))
    unit = float(10 ** np.floor(np.log10(projection.size[0] / 3)))
    length = max(step * unit for step in (1, 2, 5) if step * unit <= projection.size[0] / 3)
    bar = WIDTH * length / float(projection.size[0])
    return Drawing(
        title, draw_scene(scene, projection, PIXELS, colours), height, _spread(marks, height), bar, f"{length:g}"
    )


def _mark(
    name: str,
    colour: str,
    kind: str,
    box: Box,
    projection: Projection,
    at: NDArray[np.float64] | None = None,
    vertices: F32 | None = None,
) -> Mark:
    flat = WIDTH * projection.flat(np.array([box.low, box.high]))
    (left, top), (right, bottom) = flat.min(axis=0), flat.max(axis=0)
    outline, label = np.zeros((0, 2)), np.array([left + 2, top + LINE - 1])
    if vertices is not None:
        outline = _outline(WIDTH * projection.flat(vertices))
        label = outline.mean(axis=0) + np.array([-LETTER * len(name) / 2, LINE / 3])
    return Mark(
        name,
        colour,
        kind,
        _path(np.array([[left, top], [right, top], [right, bottom], [left, bottom]])),
        _path(outline),
        None if at is None else tuple((WIDTH * projection.flat(at)).tolist()),
        tuple(label.tolist()),
    )


def _outline(flat: NDArray[np.float64]) -> NDArray[np.float64]:
    """The extreme points of a set, in order: its convex outline, but for what lies between `EXTREMES` directions."""
    angle = 2 * np.pi * np.arange(EXTREMES) / EXTREMES
    extreme = (flat @ np.array([np.cos(angle), np.sin(angle)])).argmax(axis=0)
    return flat[list(dict.fromkeys(extreme.tolist()))]


def _path(corners: NDArray[np.float64]) -> str:
    return "M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in corners) + "Z" if len(corners) else ""


def _spread(marks: list[Mark], height: float) -> list[Mark]:
    """The marks with labels moved down, or up at the lower end, until none is on another."""
    placed: list[Mark] = []
    for mark in marks:
        width = LETTER * len(mark.name)
        x = float(np.clip(mark.label[0], 1, max(WIDTH - width - 1, 1)))
        y = float(np.clip(mark.label[1], LINE, max(height - 2, LINE)))
        step = LINE if y < height / 2 else -LINE
        while any(_meet((x, y, width), (*other.label, LETTER * len(other.name))) for other in placed):
            y += step
            if not LINE <= y <= height - 2:
                break
        placed.append(replace(mark, label=(x, y)))
    return placed


def _meet(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    beside = one[0] + one[2] < other[0] or other[0] + other[2] < one[0]
    return not beside and abs(one[1] - other[1]) < LINE
