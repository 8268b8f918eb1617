"""The report as Markdown, with its plots and pictures in files beside it."""

from __future__ import annotations

from photonfarm.trainer.compare.markdown import markdown_table
from photonfarm.trainer.report.contents import ReportContents
from photonfarm.trainer.report.plots import Plot, by_kind
from photonfarm.trainer.report.tables import Table, facts, tables
from photonfarm.trainer.report.verdict import Verdict


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
