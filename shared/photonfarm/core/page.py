"""The page kit: HTML pages, each a file that needs no other, and tables for pages and texts alike.

A page is a Jinja2 template that extends `page.html.j2`, which has the frame and the styles of `page.css`, and takes
tables, facts, figures and plots from `parts.html.j2`.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from photonfarm.core.errors import store_errors
from photonfarm.core.formatting import format_markdown_table
from photonfarm.core.pictures import data_uri

HERE = Path(__file__).parent
STYLES = HERE / "page.css"  # of these pages, and of those that are served

EMPTY = ("", "–")
"""The cells that say nothing."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table with a head; `notes` are sentences below it, without their full stops."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def drop_empty_columns(self) -> Table:
        """The table without the columns that say nothing in any row."""
        kept = [i for i in range(len(self.head)) if not self.rows or any(row[i] not in EMPTY for row in self.rows)]
        rows = [[row[i] for i in kept] for row in self.rows]
        return replace(self, head=[self.head[i] for i in kept], rows=rows)

    def format_markdown(self) -> str:
        """The table and its notes as Markdown, without the title."""
        notes = "\n".join(f"- {note}" for note in self.notes)
        return f"{format_markdown_table(self.head, self.rows)}\n\n{notes}".rstrip()


def render_page(template: Path, **values: Any) -> str:
    """The page of a template, with the kit's templates at hand. Text is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([template.parent, HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"uri": data_uri, "breakable": breakable, "base64": lambda data: b64encode(data).decode()}
    return environment.get_template(template.name).render(**values)


def write_page(file: Path, text: str) -> None:
    """Write a page to a file, whose folder is made. Raises StoreError."""
    with store_errors("write the page", file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")


def breakable(text: str) -> Markup:
    """A text whose names may break after an underscore."""
    return Markup(str(escape(text)).replace("_", "_<wbr>"))  # noqa: S704 - it is escaped
