"""`photonfarm scene check`: a scene is loaded once, measured, drawn and rendered, and its spec compared with that."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from photonfarm.core.pictures import Picture
from photonfarm.core.records import F32
from photonfarm.core.waiting import Log, WorkLog
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.check import drawings, samples, shape_pictures
from photonfarm.renderer.tools.check.drawings import Drawing
from photonfarm.renderer.tools.check.findings import Finding, Measured, collect_findings
from photonfarm.renderer.tools.check.shapes import ShapeFacts, facts_of, groups_by_shape, placements
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec

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
