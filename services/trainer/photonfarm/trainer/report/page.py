"""The report as one HTML file that needs nothing else: pictures and plots are in it."""

from __future__ import annotations

from pathlib import Path

from photonfarm.shared.core.pages import rendered
from photonfarm.trainer.compare.evaluation_table import views_of
from photonfarm.trainer.metrics import confidence_interval
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.pictures import cases, first_row, legend_of_cases
from photonfarm.trainer.report.plots import CURVES, Plot, by_kind
from photonfarm.trainer.report.tables import facts, tables

TEMPLATE = Path(__file__).with_name("report.html.j2")
LARGE_WIDTH = 256  # px, at least, of the pictures of the first row


def page(contents: ReportContents, drawn: list[Plot]) -> str:
    """The report's HTML."""
    curves = [plot for plot in drawn if plot.name.startswith(CURVES)]
    return rendered(
        TEMPLATE,
        title=f"photonfarm: {contents.card.spec.name}",
        first_row=first_row(contents),
        large_width=LARGE_WIDTH,
        curves=by_kind(curves),
        headline=headline(contents),
        views=views_of(contents.evaluation),
        tables=tables(contents),
        other_plots=by_kind([plot for plot in drawn if plot not in curves]),
        cases=cases(contents),
        legend=legend_of_cases(contents),
        facts=facts(contents),
    )


def headline(contents: ReportContents) -> list[tuple[str, str]]:
    """Figures of the data and of the first entry, each with what it is."""
    card, evaluation = contents.card, contents.evaluation
    samples, colour = card.samples, contents.baselines.mean_colour.error.mean
    first = contents.entries[0]
    error, reach = first.row.held_out.error, confidence_interval(first.row.held_out.error)
    spread = "" if reach is None else f" (95 %: {reach[0]:.3g} … {reach[1]:.3g})"
    rate = 1 / card.core_s_per_sample if card.core_s_per_sample else None
    return [
        (f"{samples.rows}", f"samples of {samples.planned} planned, held-out ones among them"),
        ("–" if rate is None else f"{rate:.2f}", "samples per core-second"),
        (f"{error.mean:.4g}", f"held-out error of {first.name}{spread}"),
        (f"{contents.baselines.untrained.error.mean:.4g}", f"of {first.name} before its first step"),
        (f"{colour:.4g}", f"of the mean colour{f': {colour / error.mean:.1f} × as much' if error.mean > 0 else ''}"),
        (f"{evaluation.noise_floor:.4g}", "noise of the targets"),
    ]
