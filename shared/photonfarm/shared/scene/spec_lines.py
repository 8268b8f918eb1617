"""The lines of a spec's file on which its keys stand, for messages: `view.origin`, `objects.1.box`, … → a line.

Python's TOML reader gives no lines, but a file's statements (a table's head, or a key with its value, which may go over
several lines) can each be read alone.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class SpecLines:
    """A spec's file, and where its keys stand in it."""

    file: Path
    lines: Mapping[str, int]  # from 1; empty for a spec in JSON

    @classmethod
    def of(cls, file: Path) -> Self:
        """The lines of a file that holds a valid spec."""
        return cls(file, lines_of(file.read_text(encoding="utf-8-sig")) if file.suffix == ".toml" else {})

    def line(self, key: str) -> int | None:
        """The line of a key, or of the innermost table around it that the file has; None if it has none."""
        while key and key not in self.lines:
            key = key.rpartition(".")[0]
        return self.lines.get(key)

    def place(self, key: str) -> str:
        """The file, and the line of a key if it has one, in words."""
        line = self.line(key)
        return f"{self.file}" if line is None else f"{self.file} line {line}"


def lines_of(text: str) -> dict[str, int]:
    """The line of each key of a valid TOML document, from 1; elements of arrays of tables are numbered from 0."""
    found: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for line, statement, parsed in _statements(text):
        if statement.startswith("["):
            table = _entered(parsed, counts)
            found.setdefault(table, line)
        else:
            for key in _keys(parsed):
                found.setdefault(f"{table}.{key}" if table else key, line)
    return found


def _statements(text: str) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Each statement with its line, and what it says alone; comments and empty lines are left out."""
    start, pending = 1, ""
    for number, line in enumerate(text.splitlines(), 1):
        start = start if pending else number
        pending += line + "\n"
        try:
            parsed = tomllib.loads(pending)
        except tomllib.TOMLDecodeError:  # it goes on
            continue
        if parsed:
            yield start, pending.strip(), parsed
        pending = ""


def _entered(head: dict[str, Any], counts: dict[str, int]) -> str:
    """The table that a head opens; an element of an array is counted."""
    path = ""
    inner: Any = head
    while inner:
        ((key, inner),) = inner.items()
        path = f"{path}.{key}" if path else key
        if isinstance(inner, list):
            counts[path] = counts.get(path, -1) + 1
            inner = inner[0]
        if path in counts:
            path = f"{path}.{counts[path]}"
    return path


def _keys(value: Any) -> Iterator[str]:
    """All keys in a value, and in the tables in it."""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for key, below in inner:
        yield str(key)
        if isinstance(below, dict) or (isinstance(below, list) and below and isinstance(below[0], dict)):
            yield from (f"{key}.{name}" for name in _keys(below))
