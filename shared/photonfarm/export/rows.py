"""Rows of a store as text, such as 0-31,40."""

from __future__ import annotations

import re
from collections.abc import Iterable

_RANGE = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?")


def ranges(rows: Iterable[int]) -> str:
    """Rows as ranges: 0, 1, 2, 7 is 0-2,7."""
    found: list[list[int]] = []
    for row in sorted(rows):
        if found and row == found[-1][1] + 1:
            found[-1][1] = row
        else:
            found.append([row, row])
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in found)


def spans(text: str) -> list[range]:
    """The ranges that a text names, in its order; raises ValueError for other text."""
    found = []
    for part in filter(None, text.split(",")):
        match = _RANGE.fullmatch(part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"{part.strip()!r} is no row and no range of rows; write them like 0-31,40")
        found.append(range(int(match[1]), int(match[2] or match[1]) + 1))
    return found


def rows_in(text: str) -> list[int]:
    """The rows that `ranges` wrote."""
    return [row for span in spans(text) for row in span]
