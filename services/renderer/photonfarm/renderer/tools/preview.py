"""The contact sheet: the samples of a store on one page that needs no other file, each with a plan of its room."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from photonfarm.core import pictures
from photonfarm.core.page import render_page, write_page
from photonfarm.core.pictures import Picture
from photonfarm.core.records import Geometry, Photons
from photonfarm.renderer.tools.plan_view import PlanView, Standing, format_point, hue
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera
from photonfarm.store.read.batch import Sample
from photonfarm.store.read.reader import SceneReader

COLUMNS = ("A", "B", "albedo", "normal", "depth", "photons")

NO_GEOMETRY = Geometry(
    np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), np.zeros(0, np.int32), np.zeros(0, np.int16)
)
"""What is known of a scene before its first job."""

TEMPLATE = Path(__file__).with_name("preview.html.j2")


@dataclass(frozen=True, slots=True)
class SheetRow:
    """One sample of the sheet."""

    number: int  # its row in the store
    camera: str
    floor_plan: Markup
    standing: list[Standing]
    panels: list[tuple[str, Picture]]  # by COLUMNS


def contact_sheet(reader: SceneReader, count: int) -> str:
    """The page (HTML) of up to `count` complete samples, spread evenly over the store."""
    reader.refresh()
    shown = reader.rows[np.unique(np.linspace(0, len(reader.rows) - 1, min(count, len(reader.rows))).astype(np.int64))]
    spec = reader.spec
    floor_plan = PlanView.of(spec, reader.base()[0] if reader.ready() else NO_GEOMETRY)
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {spec.name}",
        spec=spec,
        complete=len(reader.rows),
        hues=[hue(i) for i in range(len(spec.groups))],
        shell=floor_plan.shell(),
        places=floor_plan.places("where objects and cameras may stand, from above"),
        groups=[(Standing.of(spec, i), group) for i, group in enumerate(spec.groups)],
        rows=[_row(reader, floor_plan, int(row)) for row in shown],
    )


def write_contact_sheet(reader: SceneReader, count: int, out: Path) -> None:
    """Write the page to a file."""
    write_page(out, contact_sheet(reader, count))


def _row(reader: SceneReader, floor_plan: PlanView, row: int) -> SheetRow:
    sample, spec = reader.read(row), reader.spec
    a, b = (pictures.display(half, spec.exposure) for half in sample.radiance)
    panels = (
        a,
        b,
        pictures.draw_albedo(sample.buffers.albedo),
        pictures.draw_normal(sample.buffers.normal),
        pictures.draw_depth(sample.buffers.depth),
        photon_picture(sample, reader.read_photons(row) if spec.photons.paths else None, spec),
    )
    return SheetRow(
        row,
        f"camera at {format_point(sample.view.origin)}, looking at {format_point(sample.view.target)}",
        floor_plan.configuration(sample.modification, [sample.view]),
        [Standing.of(spec, i, sample.modification) for i in range(len(spec.groups))],
        list(zip(COLUMNS, panels, strict=True)),
    )


def photon_picture(sample: Sample, photons: Photons | None, spec: SceneSpec) -> Picture:
    """The photons that this view sees, each as a dot of its colour on the dimmed albedo; (H, W, 3)."""
    canvas = 0.15 * sample.buffers.albedo
    if photons is not None:
        seen, camera = sample.visibility.photons, Camera.of(sample.view, spec)
        offset, power = photons.position[seen] - camera.origin, photons.power[seen]
        scale = camera.focal_px / (offset @ camera.forward)
        u = np.floor(scale * (offset @ camera.right) + camera.width / 2).clip(0, camera.width - 1).astype(int)
        v = np.floor(scale * (offset @ camera.down) + camera.height / 2).clip(0, camera.height - 1).astype(int)
        # Its hue alone, as powers differ by orders of magnitude; of two photons in a pixel the last is drawn
        canvas[v, u] = power / np.maximum(power.max(axis=1, keepdims=True), 1e-30)
    return pictures.draw_albedo(canvas)
