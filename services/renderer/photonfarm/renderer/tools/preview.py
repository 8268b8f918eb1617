"""The contact sheet: the samples of a store on one page that needs no other file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photonfarm.shared.core import pictures
from photonfarm.shared.core.pages import rendered
from photonfarm.shared.core.pictures import Picture
from photonfarm.shared.core.records import Photons
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera
from photonfarm.shared.store.read.reader import SceneReader, StoredSample

COLUMNS = ("A", "B", "albedo", "normal", "depth", "photons")

TEMPLATE = Path(__file__).with_name("preview.html.j2")


@dataclass(frozen=True, slots=True)
class SheetRow:
    """One sample of the sheet."""

    number: int  # its row in the store
    removed: list[str]  # groups that are not there
    panels: tuple[Picture, ...]  # in the order of COLUMNS


def contact_sheet(reader: SceneReader, count: int) -> str:
    """The page (HTML) of up to `count` complete samples, spread evenly over the store."""
    reader.refresh()
    shown = reader.rows[np.unique(np.linspace(0, len(reader.rows) - 1, min(count, len(reader.rows))).astype(np.int64))]
    spec = reader.spec
    caption = (
        f"{len(reader.rows)} complete samples of scene {spec.scene_id}; {len(shown)} shown. A and B are independent "
        f"half-estimates of {spec.transport.half_spp} samples per pixel each, shown as "
        f"clip({spec.exposure:g} · I, 0, 1)^(1/2.2)."
    )
    rows = [_line(reader, int(row)) for row in shown]
    return rendered(TEMPLATE, title=f"photonfarm: {spec.name}", caption=caption, columns=COLUMNS, rows=rows)


def write_contact_sheet(reader: SceneReader, count: int, out: Path) -> None:
    """Write the page to a file."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(contact_sheet(reader, count))


def _line(reader: SceneReader, row: int) -> SheetRow:
    sample, spec = reader.read(row), reader.spec
    a, b = (pictures.display(half, spec.exposure) for half in sample.radiance)
    panels = (
        a,
        b,
        pictures.of_albedo(sample.buffers.albedo),
        pictures.of_normal(sample.buffers.normal),
        pictures.of_depth(sample.buffers.depth),
        photon_picture(sample, reader.read_photons(row) if spec.photons.paths else None, spec),
    )
    removed = [g.name for g, there in zip(spec.groups, sample.modification.present, strict=True) if not there]
    return SheetRow(row, removed, panels)


def photon_picture(sample: StoredSample, photons: Photons | None, spec: SceneSpec) -> Picture:
    """The photons that this view sees, each as a dot of its colour on the dimmed albedo; (H, W, 3)."""
    canvas = 0.15 * sample.buffers.albedo
    if photons is not None:
        seen, camera = sample.visibility.photons, Camera.of(sample.view, spec)
        offset, power = photons.position[seen] - camera.origin, photons.power[seen]
        scale = camera.focal_px / (offset @ camera.forward)
        u = np.floor(scale * (offset @ camera.right) + camera.width / 2).clip(0, camera.width - 1).astype(int)
        v = np.floor(scale * (offset @ camera.down) + camera.height / 2).clip(0, camera.height - 1).astype(int)
        canvas[v, u] = power / np.maximum(power.max(axis=1, keepdims=True), 1e-30)
    return pictures.of_albedo(canvas)
