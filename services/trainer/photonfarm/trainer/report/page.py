"""The report as one HTML file, which contains its pictures and plots."""

from __future__ import annotations

import base64
from html import escape

from photonfarm.shared.core.pictures import Picture, png_uri
from photonfarm.trainer.compare.evaluation_table import views_of
from photonfarm.trainer.metrics import confidence_interval
from photonfarm.trainer.report.contents import Contents
from photonfarm.trainer.report.pictures import Case, Panel, cases, first_row, legend_of_cases
from photonfarm.trainer.report.plots import CURVES, Plot, by_kind
from photonfarm.trainer.report.tables import Table, facts, tables

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 76rem; margin: 1.5rem auto;
       padding: 0 1rem; }
h1 { font-size: 1.5rem; overflow-wrap: anywhere; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.figures { display: flex; flex-wrap: wrap; gap: .8rem; }
.figures div { border: 1px solid #ddd; border-radius: 6px; padding: .5rem .9rem; }
.figures b { display: block; font-size: 1.25rem; }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; }
.plots img { width: 28rem; max-width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .8rem; }
td, th { padding: .25rem .55rem .25rem 0; text-align: left; font-weight: normal; vertical-align: top; }
thead th { color: #555; border-bottom: 1px solid #ccc; vertical-align: bottom; }
tbody tr:nth-child(even) { background: #f7f7f7; }
.wide td { white-space: nowrap; }
td:first-child { position: sticky; left: 0; background: inherit; }
tbody tr { background: #fff; }
.row { display: grid; grid-template-columns: repeat(4, 1fr); gap: .8rem; margin: 1rem 0 1.6rem; }
.row figure { width: auto; } .row figcaption { font-size: .85rem; }
@media (max-width: 40rem) { .row { grid-template-columns: repeat(2, 1fr); } }
.case { display: flex; flex-wrap: wrap; gap: .6rem; margin-bottom: 1.6rem; }
figure { margin: 0; width: 8.5rem; }
figure img { width: 100%; image-rendering: pixelated; display: block; margin-bottom: 2px; }
figcaption { font-size: .72rem; line-height: 1.3; overflow-wrap: anywhere; }
p, li { max-width: 52rem; } li, code { overflow-wrap: anywhere; }
ul { padding-left: 1.2rem; font-size: .88rem; color: #444; }
.facts td { overflow-wrap: anywhere; } .facts td:first-child { color: #555; white-space: nowrap; }
"""
PICTURE_WIDTH = 128  # px, at least, of a picture as it is stored in the page
LARGE_WIDTH = 256  # px, of those of the first row


def page(contents: Contents, drawn: list[Plot]) -> str:
    """The report's HTML."""
    title = f"photonfarm: {contents.card.spec.name}"
    first, *others = tables(contents)
    curves = [plot for plot in drawn if plot.name.startswith(CURVES)]
    parts = [
        f"<h1>{escape(title)}</h1>",
        _first_row(first_row(contents)),
        *(_plots(*kind) for kind in by_kind(curves)),
        _headline(contents),
        _table(first),
        *(_plots(*kind) for kind in by_kind([plot for plot in drawn if plot not in curves])),
        _pictures(cases(contents), contents),
        *map(_table, others),
        _facts(contents),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head><body>\n'
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _first_row(panels: list[Panel]) -> str:
    """The first part of the page: large pictures side by side."""
    figures = "".join(_figure(panel.caption, (panel.picture, panel.caption), width=LARGE_WIDTH) for panel in panels)
    return f'<div class="row">{figures}</div>'


def _headline(contents: Contents) -> str:
    card, evaluation = contents.card, contents.evaluation
    samples, colour = card.samples, contents.gauges.mean_colour.error.mean
    first = contents.entries[0]
    error, reach = first.row.held_out.error, confidence_interval(first.row.held_out.error)
    spread = "" if reach is None else f" (95 %: {reach[0]:.3g} … {reach[1]:.3g})"
    rate = 1 / card.core_s_per_sample if card.core_s_per_sample else None
    cells = [
        (f"{samples.rows}", f"samples of {samples.planned} planned, held-out ones among them"),
        ("–" if rate is None else f"{rate:.2f}", "samples per core-second"),
        (f"{error.mean:.4g}", f"held-out error of {first.name}{spread}"),
        (f"{contents.gauges.untrained.error.mean:.4g}", f"of {first.name} before its first step"),
        (f"{colour:.4g}", f"of the mean colour{f': {colour / error.mean:.1f} × as much' if error.mean > 0 else ''}"),
        (f"{evaluation.noise_floor:.4g}", "noise of the targets"),
    ]
    boxes = "".join(f"<div><b>{value}</b>{escape(name)}</div>" for value, name in cells)
    return (
        f'<div class="figures">{boxes}</div>\n<p>Errors are mean squared errors of linear radiance × exposure, on '
        f"one sample of each of {views_of(evaluation)} that were never trained on. The "
        "noise of the targets is taken out exactly: each sample has two independent renders A and B, and "
        "(f − A)(f − B) averages to the error against the clean image. Noise would add the last figure on top.</p>"
    )


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.head)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in table.rows)
    notes = "".join(f"<li>{escape(note)}.</li>" for note in table.notes)
    return (
        f'<h2>{escape(table.title)}</h2>\n<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody>'
        f"</table></div>{f'<ul>{notes}</ul>' if notes else ''}"
    )


def _plots(title: str, said: str, drawn: list[Plot]) -> str:
    images = "".join(
        f'<img alt="{escape(plot.about)}" src="data:image/svg+xml;base64,{base64.b64encode(plot.svg).decode()}">'
        for plot in drawn
    )
    return f'<h2>{escape(title)}</h2>\n<p>{escape(said)}</p>\n<div class="plots">{images}</div>'


def _pictures(found: list[Case], contents: Contents) -> str:
    blocks = []
    for case in found:
        figures = [_figure("target", (case.target, "target"))]
        for shown in case.shown:
            images = (shown.picture, f"image by {shown.name}"), (shown.difference, f"difference of {shown.name}")
            figures.append(_figure(f"{shown.name}, MSE {shown.mse:.4f}", *images))
        blocks.append(f'<h3>{escape(case.caption)}</h3><div class="case">{"".join(figures)}</div>')
    legend = f"<p>{escape(legend_of_cases(contents))}</p>"
    return f"<h2>Held-out views</h2>\n{legend}\n{''.join(blocks)}"


def _figure(caption: str, *pictures: tuple[Picture, str], width: int = PICTURE_WIDTH) -> str:
    """Pictures with their alternative texts, one below the other, enlarged to at least `width`."""
    images = "".join(
        f'<img alt="{escape(alt)}" src="{png_uri(picture, max(1, -(-width // picture.shape[1])))}">'
        for picture, alt in pictures
    )
    return f"<figure>{images}<figcaption>{escape(caption).replace('_', '_<wbr>')}</figcaption></figure>"


def _facts(contents: Contents) -> str:
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in facts(contents))
    return f'<h2>The data</h2>\n<table class="facts"><tbody>{rows}</tbody></table>'
