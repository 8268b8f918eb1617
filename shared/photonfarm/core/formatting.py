"""Numbers with their units, and tables, as text: one way for all that prints, logs or writes a page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def format_count(number: int, noun: str) -> str:
    """A number with its noun: "1 view", "3 views"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def format_bytes(size_bytes: float) -> str:
    """A size as people say it: 3.4 MB, 128.0 MB, 2.10 GB."""
    return f"{size_bytes / 1e9:,.2f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.1f} MB"


def format_share(share: float) -> str:
    """A share in per cent, of two digits, or from 10 % on a whole number: "0.068 %", "7.5 %", "123 %"."""
    return f"{100 * share:.2g} %" if abs(share) < 0.1 else f"{100 * share:.0f} %"


def format_milliseconds(seconds: float) -> str:
    """A short time in milliseconds, without the unit."""
    return f"{1e3 * seconds:.1f}"


def format_markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The head, a rule and the rows, a line each; a bar in a cell becomes ∣.

    Raises ValueError for a row of another number of cells.
    """
    lines = [head, ["---"] * len(head), *rows]
    if wrong := next((line for line in lines if len(line) != len(head)), None):
        raise ValueError(f"a table of {len(head)} columns has a row of {len(wrong)} cells: {wrong}")
    return "\n".join(f"| {' | '.join(cell.replace('|', '∣') for cell in line)} |" for line in lines)
