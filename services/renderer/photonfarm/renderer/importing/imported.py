"""An imported scene, in Mitsuba's terms: what every reader makes, whatever the file was."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

Vector = tuple[float, float, float]

_NOT_OF_AN_ID = re.compile(r"[^0-9A-Za-z_-]+")

ID_LENGTH = 48


@dataclass(slots=True)
class ImportedScene:
    """A scene as Mitsuba 3 reads it, with what the source says of it beyond that."""

    root: Element  # <scene>: materials first, then shapes with ids, and lights; files by their absolute names
    objects: dict[str, str] = field(default_factory=dict)  # the object that a shape id belongs to, where the file says
    notes: list[str] = field(default_factory=list)  # sentences: what was changed, or is not carried over
    up: Vector = (0.0, 1.0, 0.0)
    camera: Vector | None = None  # the position of the source's camera, which is inside the room, most likely


def listed(names: Sequence[str], most: int = 4) -> str:
    """The first names of some, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class Ids:
    """Distinct ids of shapes and materials, made of names that may be anything."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def make(self, name: str, otherwise: str = "shape") -> str:
        """An id like `name`, with a number behind it if the name itself is taken."""
        stem = _NOT_OF_AN_ID.sub("_", name).strip("_-")[:ID_LENGTH] or otherwise
        made, number = stem, 1
        while made in self._taken:
            number += 1
            made = f"{stem}_{number}"
        self._taken.add(made)
        return made

    def keep(self, name: str) -> bool:
        """Take a name as it is; False if it is taken."""
        if name in self._taken:
            return False
        self._taken.add(name)
        return True
