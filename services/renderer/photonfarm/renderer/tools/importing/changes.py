"""What an import changes: said whatever it is, and refused unless accepted where it changes the picture."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from shlex import quote
from typing import Literal

from photonfarm.core.errors import SpecError

Effect = Literal["geometry", "light", "colour"]
"""What of the picture differs: surfaces that are missing, moved or of another shape; light; a surface's appearance."""


@dataclass(frozen=True, slots=True)
class Change:
    """One kind of change, and where it was met."""

    effect: Effect | None  # None: nothing of the picture
    name: str  # as the file has it, such as an extension; `--accept` names it
    meaning: str
    places: list[str] = field(default_factory=list)  # nodes, materials or lines

    def __str__(self) -> str:
        where = f" ({name_some(self.places)})" if self.places else ""
        if self.effect is None:
            return f"{self.name}: {self.meaning}{where}" if self.name else f"{self.meaning}{where}"
        return f"{self.effect} differs: {self.name}: {self.meaning}{where}"


@dataclass(slots=True)
class Changes:
    """All that an import changes, in the order in which it was met; changes of one kind are one, of many places."""

    _found: dict[tuple[Effect | None, str, str], Change] = field(default_factory=dict)

    def note(self, meaning: str, place: str = "", *, name: str = "") -> None:
        """Say what does not change the picture."""
        self.say(None, name, meaning, place)

    def lose(self, effect: Effect, name: str, meaning: str, place: str = "") -> None:
        """Say what differs from the file: `lose("colour", "COLOR_0", "has no vertex colours", "node 'Sofa'")`."""
        self.say(effect, name, meaning, place)

    def say(self, effect: Effect | None, name: str, meaning: str, place: str = "") -> None:
        """Say what differs from the file in its `effect`, or in nothing of the picture."""
        change = self._found.setdefault((effect, name, meaning), Change(effect, name, meaning))
        if place and place not in change.places:
            change.places.append(place)

    def __iter__(self) -> Iterator[Change]:
        return iter(self._found.values())

    def refuse_unless(self, accepted: Collection[str], source: str) -> None:
        """Raise SpecError for what changes the picture, unless its name or its effect is accepted, in any case."""
        names = [(change, {change.name.lower(), str(change.effect)}) for change in self if change.effect is not None]
        given = {each.lower(): each for each in accepted}
        refused = [change for change, own in names if not {*own, "all"} & given.keys()]
        if not refused:
            return
        lines = "".join(f"\n  {change}" for change in refused)
        unknown = [each for key, each in given.items() if not any(key in own for _, own in names)]
        lines += "".join(f"\n  --accept {quote(each)}: nothing of that name differs here" for each in unknown)
        options = " ".join(dict.fromkeys(f"--accept {quote(change.name)}" for change in refused))
        raise SpecError(
            f"{source}: the picture would differ from the file's:{lines}\nMend the file, or import it all the same by "
            f"{options}"
        )


def name_some(names: Sequence[str], most: int = 4) -> str:
    """The first names of some, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
