"""The report as one HTML file that needs nothing else: pictures inline, curves as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from photonfarm.shared.pictures import display, of_albedo, png_uri
from photonfarm.trainer.curve import Level, learning_curve
from photonfarm.trainer.figures import Shown
from photonfarm.trainer.waits import stated

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 62rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
.figures { display: flex; flex-wrap: wrap; gap: .8rem; }
.figures div { border: 1px solid #ddd; border-radius: 6px; padding: .5rem .9rem; }
.figures b { display: block; font-size: 1.25rem; }
.curves { display: flex; flex-wrap: wrap; gap: 1rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .6rem .2rem 0; text-align: left; font-weight: normal;
        vertical-align: top; } th { color: #555; }
.pictures td, .pictures th { text-align: center; max-width: 8.5rem; }
img { image-rendering: pixelated; display: block; }
p, li { max-width: 46rem; } code { overflow-wrap: anywhere; }
"""
PICTURE_WIDTH = 128  # px on the page, at least


def page(figures: dict[str, Any], records: Sequence[dict[str, Any]], shown: Sequence[Shown]) -> str:
    """The report's HTML from the figures of report.json, the validation records and the pictures."""
    title = f"photonfarm: {figures['scene']} after {figures['train_steps']} steps"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>\n'
        f"<h1>{escape(title)}</h1>\n{_headline(figures)}\n{_curves(figures, records)}\n{_pictures(shown)}\n"
        f"{_details(figures)}\n</body></html>\n"
    )


def _headline(figures: dict[str, Any]) -> str:
    first, last, colour = (figures[f"val_error_{name}"] for name in ("first", "last", "mean_colour"))
    rate, spread = figures["samples_per_core_second"], figures["val_error_last_standard_error"]
    cells = [
        (f"{figures['samples_committed']}", f"samples of {figures['samples_planned']} planned"),
        ("–" if rate is None else f"{rate:.2f}", "samples per core-second"),
        (f"{last:.4g}", f"held-out error (± {'–' if spread is None else f'{spread:.2g}'})"),
        (f"{first:.4g}", f"before training: {first / last:.1f} ×" if last > 0 else "before training"),
        (f"{colour:.4g}", f"mean colour: {colour / last:.1f} ×" if last > 0 else "mean colour"),
        (f"{figures['noise_floor']:.4g}", "noise of the targets"),
    ]
    boxes = "".join(f"<div><b>{value}</b>{escape(name)}</div>" for value, name in cells)
    return (
        f'<div class="figures">{boxes}</div>\n<p>Errors are mean squared errors of linear radiance × exposure, on '
        f"{figures['samples_held_out']} samples of configurations that were never trained on. The noise of the targets "
        "is taken out exactly: each sample has two independent renders A and B, and (f − A)(f − B) averages to the "
        "error against the clean image, which nobody rendered. Noise would add the last figure on top.</p>"
    )


def _curves(figures: dict[str, Any], records: Sequence[dict[str, Any]]) -> str:
    levels = [
        Level("mean colour", figures["val_error_mean_colour"], "#a85a1f"),
        Level("noise of the targets", figures["noise_floor"], "#777777"),
    ]
    rate = figures["samples_per_core_second"]
    per_sample = 1 / rate if rate else 0.0
    over_steps = [(r["step"], r["error"]) for r in records]
    over_cost = [(r["samples"] * per_sample + r["seconds"]["train"], r["error"]) for r in records]
    return (
        f'<h2>Learning</h2>\n<div class="curves">{learning_curve(over_steps, levels, "training steps")}'
        f"{learning_curve(over_cost, levels, 'core-seconds: rendering what had arrived, and training')}</div>\n"
        "<p>While samples arrive, the held-out ones grow in number; the points are of those that were there.</p>"
    )


def _pictures(shown: Sequence[Shown]) -> str:
    rows = "".join(_picture_row(sample) for sample in shown)
    return (
        '<h2>Held-out samples</h2>\n<table class="pictures"><tr><th>target (A + B)/2, noisy</th><th>prediction</th>'
        f"<th>albedo</th><th>|prediction − target|</th><th>error</th></tr>{rows}</table>\n"
        "<p>Shown as clip(exposure · I, 0, 1)<sup>1/2.2</sup>.</p>"
    )


def _picture_row(sample: Shown) -> str:
    pictures = (
        ("target", display(sample.target, 1.0)),
        ("prediction", display(sample.prediction, 1.0)),
        ("albedo", of_albedo(sample.albedo)),
        ("difference", display(np.abs(sample.prediction - sample.target), 1.0)),
    )
    scale = max(1, -(-PICTURE_WIDTH // sample.target.shape[1]))
    cells = "".join(
        f'<td><img alt="{name} of row {sample.row}" src="{png_uri(picture, scale)}"></td>' for name, picture in pictures
    )
    return f"<tr>{cells}<td>{sample.error:.4g}</td></tr>"


def _details(figures: dict[str, Any]) -> str:
    seconds = ", ".join(f"{name.replace('_', ' ')} {value:.1f}" for name, value in figures["seconds"].items())
    settings = figures["settings"]
    rows = [
        ("scene id", figures["scene_id"]),
        ("network", f"{settings['network']['architecture']}, {figures['parameters']:,} parameters"),
        ("draws", f"{figures['draws']}, {figures['draws_per_sample']:.1f} of each training sample"),
        ("seconds", seconds),
        ("waits", stated(figures["waits"], figures["samples_per_used"])),
        ("rendering", f"{figures['render_core_seconds']:.1f} core-seconds, {figures['renders_redrawn']} drawn again"),
        ("seeds", ", ".join(f"{k} {v}" for k, v in figures["seeds"].items())),
        ("versions", ", ".join(f"{k} {v}" for k, v in figures["versions"].items())),
        ("settings", ", ".join(f"{k} = {v}" for k, v in {**settings, **settings["network"]}.items() if k != "network")),
    ]
    cells = "".join(f"<tr><th>{name}</th><td><code>{escape(str(value))}</code></td></tr>" for name, value in rows)
    return f"<h2>Details</h2>\n<table>{cells}</table>"
