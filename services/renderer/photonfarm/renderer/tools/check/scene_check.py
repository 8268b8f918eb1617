"""`photonfarm scene check`: a scene is loaded once, measured, drawn and rendered, and its spec compared with that.

What was found is a page (HTML), one file that needs no other.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from photonfarm.core.formatting import format_share
from photonfarm.core.page import render_page, write_page
from photonfarm.core.pictures import Picture
from photonfarm.core.records import F32, Geometry
from photonfarm.core.waiting import Log, WorkLog
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import look_closer
from photonfarm.renderer.tools.check import samples, shape_pictures
from photonfarm.renderer.tools.check.findings import (
    CUT_AT_ALL,
    OUTSIDE,
    Finding,
    Measured,
    collect_findings,
)
from photonfarm.renderer.tools.check.shape_pictures import Projection, draw_scene
from photonfarm.renderer.tools.check.shapes import ShapeFacts, facts_of, groups_by_shape, placements
from photonfarm.renderer.tools.measure.exposure import TARGET
from photonfarm.renderer.tools.plan_view import PlanView, Standing, hue
from photonfarm.scene.arrangement import find_doubts
from photonfarm.scene.modification import Modification
from photonfarm.scene.shot_files import name_frames
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec, SpecLines
from photonfarm.scene.view import View

TEMPLATE = Path(__file__).parents[1] / "check.html.j2"

PIXELS = 640
"""The width of plan and elevation."""

PICTURED = 240
"""The most shapes that get a picture: those of movable groups, and then the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneCheck:
    """All that a check found."""

    spec: SceneSpec
    shapes: list[ShapeFacts]
    pictures: dict[int, Picture]  # of some shapes, by their number
    measured: Measured
    drawings: list[tuple[str, Markup]]  # titles, and plans as SVG
    findings: list[Finding]
    seconds: float


def check(named: NamedSpec, log: Log) -> SceneCheck:
    """Check a spec; the backend must have been loaded. Raises SpecError and BackendError as loading does."""
    with WorkLog(log) as work:
        return _check(named, work)


def _check(named: NamedSpec, work: WorkLog) -> SceneCheck:
    begun, spec = time.monotonic(), named.spec
    work.begin(f"loading {spec.name}")
    scene = LoadedScene.load(samples.shrink_spec(spec), named.file.parent)
    group_of = groups_by_shape(spec)
    shapes = facts_of(scene.scene, group_of)
    work.begin(f"{len(shapes)} shapes; drawing them, and moving groups to {len(spec.groups)} boxes' ends")
    geometry, cloud = scene.base()
    placed = placements(scene, geometry)
    colours = shape_pictures.shape_colours(scene.scene, geometry)
    drawn = [_draw_plan(scene, spec, geometry, colours, from_above=from_above) for from_above in (True, False)]
    up = int(np.abs(spec.view.up).argmax())
    pictured = _choose_pictured(shapes, scene.boxes)
    pictures = {number: shape_pictures.draw_from_corner(geometry, number, colours[number], up) for number in pictured}
    rendered = samples.render(scene, spec, cloud, work)
    measured = Measured(scene.boxes[:, 0].min(axis=0), scene.boxes[:, 1].max(axis=0), placed, rendered)
    findings = collect_findings(spec, named.lights, measured)
    return SceneCheck(spec, shapes, pictures, measured, drawn, findings, time.monotonic() - begun)


def doubt_shots(named: NamedSpec, shots: Iterable[tuple[Modification, View]], log: Log) -> list[str]:
    """What is doubtful of configurations and views, as `name_frames` says it; the backend must have been loaded."""
    found = []
    with WorkLog(log) as work:
        work.begin(f"looking at what stands where in {named.spec.name}")
        scene = LoadedScene.load(named.spec, named.file.parent)
        for modification, view in shots:
            scene.apply(modification)
            found.append([*find_doubts(named.spec, modification, view), *look_closer(scene, modification, view)])
    return name_frames(found)


def _draw_plan(
    scene: LoadedScene, spec: SceneSpec, geometry: Geometry, colours: F32, *, from_above: bool
) -> tuple[str, Markup]:
    """The plan or the elevation of a scene at rest, over a picture of it that is cut open in front of cameras."""
    plan = PlanView.of(spec, geometry, from_above=from_above)
    (right, upward), (left, bottom), (width, height) = plan.axes, plan.low, plan.high - plan.low
    forward = np.cross(right, -upward)
    view = spec.view
    start = min(float(box @ forward) for each in (view.origin, view.look_at) for box in (each.low, each.high))
    low, high = np.array([left, -bottom - height]), np.array([left + width, -bottom])
    picture = draw_scene(scene.scene, Projection(right, -upward, forward, low, high, start), PIXELS, colours)
    cut = "Plan, cut open above the cameras" if from_above else "Elevation, cut open in front of the cameras"
    title = f"{cut}: {width:.3g} wide and {height:.3g} high"
    return title, plan.places(title, picture)


def _choose_pictured(shapes: list[ShapeFacts], boxes: F32) -> list[int]:
    """The numbers of the shapes that get a picture."""
    size = np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)
    order = sorted(range(len(shapes)), key=lambda number: (shapes[number].group is None, -size[number]))
    return order[:PICTURED]


def write(check: SceneCheck, lines: SpecLines, out: Path) -> None:
    """Write the page of a check to a file; raises StoreError where that cannot be."""
    write_page(out, page(check, lines))


def page(check: SceneCheck, lines: SpecLines) -> str:
    """The page."""
    spec, seen = check.spec, check.measured.samples
    groups = [
        (Standing.of(spec, number), group, placed)
        for number, (group, placed) in enumerate(zip(spec.groups, check.measured.placed, strict=True))
    ]
    shown = [
        (each, [g.name for g, there in zip(spec.groups, each.modification.present, strict=True) if not there])
        for each in seen.shown
    ]
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {spec.name}",
        check=check,
        spec=spec,
        file=lines.file.name,
        findings=[(finding, lines.line(finding.key)) for finding in check.findings],
        hues=[hue(number) for number in range(len(spec.groups))],
        groups=groups,
        shown=shown,
        facts_of_views=_list_facts(check),
        sections=_sections(check),
        limits={"outside": OUTSIDE, "cut": CUT_AT_ALL},
    )


def _list_facts(check: SceneCheck) -> list[tuple[str, str]]:
    """What cameras stand in and see, and how bright that is."""
    cameras, images, points = check.measured.samples.cameras, check.measured.samples.images, check.spec.points
    holders = ", ".join(name for name, _ in cameras.holders()[:3])
    median, low = np.percentile(cameras.seen, [50, 5])
    better = images.find_exposure(TARGET)
    return [
        ("cameras inside objects", f"{format_share(cameras.inside_share)}{holders and f' ({holders})'}"),
        ("cameras that look through a wall from outside", format_share(cameras.behind.mean())),
        ("cameras that see no surface", format_share(cameras.nothing.mean())),
        ("cameras within a hand of what they see", format_share(cameras.near.mean())),
        ("black pictures", f"{(~images.halves.any(axis=(1, 2, 3, 4))).sum()} of {len(images.halves)}"),
        ("points that a view sees", f"{median * points:.0f} of {points}; 5 % of views: below {low * points:.0f}"),
        (
            "display mean",
            f"{images.display_means(check.spec.exposure).mean():.2f}"
            + ("" if better is None else f"; {TARGET:g} at exposure {better:.2g}"),
        ),
    ]


def _sections(check: SceneCheck) -> list[tuple[str, list[tuple[ShapeFacts, Picture]], list[ShapeFacts]]]:
    """Shapes by movable group, and then those that do not move: with pictures, and without."""
    sections = []
    for name in (*(group.name for group in check.spec.groups), None):
        own = [(shape, check.pictures.get(i)) for i, shape in enumerate(check.shapes) if shape.group == name]
        pictured = [(shape, picture) for shape, picture in own if picture is not None]
        sections.append((name or "", pictured, [shape for shape, picture in own if picture is None]))
    return sections
