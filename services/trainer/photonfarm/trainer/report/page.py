"""The report as one HTML file that needs nothing else, and as Markdown with its plots and pictures in files beside it.

Shape letters: H W image.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from photonfarm.core.pictures import reduce_image, render_page
from photonfarm.core.records import F32
from photonfarm.trainer.compare import evaluation_table
from photonfarm.trainer.compare.comparison import markdown_table
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.plots import Plot, by_kind
from photonfarm.trainer.report.tables import Table, facts, tables
from photonfarm.trainer.report.verdict import Verdict, headline
from photonfarm.trainer.report.views import ShownView, legend


def markdown(contents: ReportContents, verdict: Verdict, drawn: list[Plot], pictures: str) -> str:
    """The page; `pictures` is the file of the held-out views, beside it as the plots NAME.svg are."""
    first, *others = tables(contents)
    card = "\n".join(f"- **{name}**: {value}" for name, value in facts(contents))
    shown = "Targets and predictions, as clip(exposure · I, 0, 1)^(1/2.2)."
    blocks = [
        f"# {contents.card.spec.name}",
        " ".join((f"**{verdict.sentence}**", *verdict.further)),
        _table(first),
        *(_plots(*kind) for kind in by_kind(drawn)),
        f"## Held-out views\n\n{shown}\n\n![targets and predictions]({pictures})",
        *map(_table, others),
        f"## The data\n\n{card}",
    ]
    return "\n\n".join(blocks) + "\n"


def _plots(title: str, explanation: str, drawn: list[Plot]) -> str:
    images = "\n".join(f"![{plot.about}]({plot.name}.svg)" for plot in drawn)
    return f"## {title}\n\n{explanation}\n\n{images}"


def _table(table: Table) -> str:
    notes = "".join(f"\n- {note}." for note in table.notes)
    return f"## {table.title}\n\n{markdown_table(table.head, table.rows)}\n{notes}".rstrip()


TEMPLATE = Path(__file__).with_name("report.html.j2")
VIEWER = Path(__file__).with_name("viewer.js")

LARGEST = 256  # px, along each side of what the page shows

MOST_LIGHT = 1_600_000
"""Characters of a page that light in half floats may take; layers beyond show their pictures' 8 bits, cut at white."""

LARGEST_HALF = np.float32(np.finfo(np.float16).max)


def page(contents: ReportContents, verdict: Verdict, views: Sequence[ShownView], drawn: list[Plot]) -> str:
    """The report's HTML."""
    return render_page(
        TEMPLATE,
        title=f"photonfarm: {contents.card.spec.name}",
        verdict=verdict,
        headline=headline(contents),
        measured=evaluation_table.views_of(contents.evaluation),
        views=views,
        largest=LARGEST,
        legend=legend(contents),
        light=light_data(views),
        viewer=VIEWER.read_text(),
        plots=by_kind(drawn),
        tables=tables(contents),
        facts=facts(contents),
    )


def light_data(views: Sequence[ShownView]) -> list[dict[str, str]]:
    """The light of each view's layers by their names, as many as fit: first those of all views that come first."""
    found: list[dict[str, str]] = [{} for _ in views]
    left = MOST_LIGHT
    for place, name, light in _by_importance(views):
        text = half_floats(light)
        left -= len(text)
        if left < 0:
            break
        found[place][name] = text
    return found


def _by_importance(views: Sequence[ShownView]) -> Iterator[tuple[int, str, F32]]:
    """The first light of every view, then the second, and so on, each with the place of its view."""
    of_views = [[each for each in (*view.images, *view.inputs) if each.light is not None] for view in views]
    for number in range(max(map(len, of_views), default=0)):
        for place, layers in enumerate(of_views):
            if number < len(layers) and (light := layers[number].light) is not None:
                yield place, layers[number].name, light


def half_floats(light: F32) -> str:
    """Light (H, W, 3) as base64 of little-endian half floats; of a large film, the means over blocks of pixels."""
    halves = np.clip(reduce_image(np.nan_to_num(light), LARGEST), -LARGEST_HALF, LARGEST_HALF).astype("<f2")
    return b64encode(halves.tobytes()).decode()
