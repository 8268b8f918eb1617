"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The head, a rule and the rows, a line each; raises ValueError for a row of another number of cells."""
    lines = [head, ["---"] * len(head), *rows]
    if wrong := next((line for line in lines if len(line) != len(head)), None):
        raise ValueError(f"a table of {len(head)} columns has a row of {len(wrong)} cells: {wrong}")
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
