"""The contact sheet: the samples of a store on one page that needs no other file."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np

from photonfarm.shared.core import pictures
from photonfarm.shared.core.pictures import Picture
from photonfarm.shared.core.records import F32, Photons
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera
from photonfarm.shared.store.read.reader import Sample, SceneReader

COLUMNS = ("A", "B", "albedo", "normal", "depth", "photons")

_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>
body {{ font: 14px/1.4 system-ui, sans-serif; margin: 2em auto; max-width: 70em; padding: 0 1em; color: #222 }}
.sheet {{ overflow-x: auto }} table {{ border-collapse: collapse }} td, th {{ padding: 2px; text-align: left }}
img {{ display: block; image-rendering: pixelated; width: 132px }} td.name {{ font-size: 12px; padding-right: 8px }}
</style><h1>{title}</h1><p>{caption}</p><div class="sheet"><table><tr><th>{head}</tr>{rows}</table></div></html>
"""


def contact_sheet(reader: SceneReader, count: int) -> str:
    """The page (HTML) of up to `count` complete samples, spread evenly over the store."""
    reader.refresh()
    shown = reader.rows[np.unique(np.linspace(0, len(reader.rows) - 1, min(count, len(reader.rows))).astype(np.int64))]
    body = "".join(_table_row(reader, int(row)) for row in shown)
    spec = reader.spec
    caption = (
        f"{len(reader.rows)} complete samples of scene {spec.scene_id}; {len(shown)} shown. A and B are independent "
        f"half-estimates of {spec.transport.half_spp} samples per pixel each, shown as "
        f"clip({spec.exposure:g} · I, 0, 1)^(1/2.2)."
    )
    return _PAGE.format(
        title=html.escape(f"photonfarm: {spec.name}"), caption=caption, head="<th>".join(("", *COLUMNS)), rows=body
    )


def write_contact_sheet(reader: SceneReader, count: int, out: Path) -> None:
    """Write the page to a file."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(contact_sheet(reader, count))


def _table_row(reader: SceneReader, row: int) -> str:
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
    scale = max(1, 128 // spec.film.width)
    cells = "".join(f'<td><img alt="" src="{pictures.png_uri(panel, scale)}">' for panel in panels)
    removed = [g.name for g, there in zip(spec.groups, sample.modification.present, strict=True) if not there]
    note = f"row {row}" + (f"<br>without {html.escape(', '.join(removed))}" if removed else "")
    return f'<tr><td class="name">{note}{cells}</tr>'


def photon_picture(sample: Sample, photons: Photons | None, spec: SceneSpec) -> Picture:
    """The photons that this view sees, each as a dot of its colour on the dimmed albedo; (H, W, 3)."""
    canvas = 0.15 * sample.buffers.albedo
    if photons is not None:
        u, v, power = _visible(sample, photons, spec)
        canvas[v, u] = power / np.maximum(power.max(axis=1, keepdims=True), 1e-30)
    return pictures.of_albedo(canvas)


def _visible(sample: Sample, photons: Photons, spec: SceneSpec) -> tuple[np.ndarray, np.ndarray, F32]:
    """Pixel columns, rows and powers of the photons that lie on what the view's depth buffer shows."""
    camera = Camera.of(sample.view, spec)
    alive = photons.bounce >= 0
    local = photons.position[alive] @ camera.world_to_camera[:, :3].T + camera.world_to_camera[:, 3]
    x, y, z = local.T
    front = z > spec.view.near
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor(camera.focal_px * x / z + camera.width / 2)
        v = np.floor(camera.focal_px * y / z + camera.height / 2)
    inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v, z, power = u[inside].astype(int), v[inside].astype(int), z[inside], photons.power[alive][inside]
    seen = np.abs(sample.buffers.depth[v, u] - z) < 0.02 * z
    return u[seen], v[seen], power[seen]
