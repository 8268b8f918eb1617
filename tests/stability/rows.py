"""The 36 rows, in order."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from tests.stability.scenes import cameras, closed_form, lights, surfaces
from tests.stability.scenes.case import BdptSettings, HardScene, Refusal

SCENES: tuple[HardScene, ...] = tuple(
    sorted((*closed_form.SCENES, *lights.SCENES, *surfaces.SCENES, *cameras.SCENES), key=lambda scene: scene.row)
)
"""All hard scenes; a row has one or a few."""
REFUSALS: tuple[Refusal, ...] = cameras.REFUSALS
"""The refusals: row 30, and others without a row."""
ROWS = 36
"""The number of rows."""


def chosen(
    only: Sequence[str] = (), *, quick: bool = False, settings: Sequence[BdptSettings] = ()
) -> list[HardScene | Refusal]:
    """Scenes and refusals by row number, name or label, in order; all of them for an empty choice.

    Scenes without a quick version, or not tried with any of the settings, are left out. Raises ValueError for a name
    that matches no scene, or if none is left.
    """
    everything: list[HardScene | Refusal] = sorted([*SCENES, *REFUSALS], key=lambda item: item.row or ROWS + 1)
    left = [item for item in everything if _is_tried(item, quick, settings)]
    for wanted in only:
        named = [item for item in everything if _is_called(item, wanted)]
        if not named:
            raise ValueError(_unknown(wanted, everything))
        if not any(item in left for item in named):
            raise ValueError(
                f"{wanted}: "
                + "; ".join(f"{item.label} is tried with {_tried_with(item)}" for item in named)
                + " (connections,light_ratio)"
            )
    return [item for item in left if not only or any(_is_called(item, wanted) for wanted in only)]


def _unknown(wanted: str, everything: Sequence[HardScene | Refusal]) -> str:
    """The message about an unknown name, in one sentence; it suggests a similar name."""
    if wanted.lstrip("-").isdigit():
        return f"there is no row {wanted}; allowed are 1 to {ROWS}"
    known = [name for item in everything for name in (item.label, item.name)]
    near = difflib.get_close_matches(wanted, known, n=1)
    meant = f"; do you mean {near[0]!r}?" if near else f"; allowed are the rows 1 to {ROWS} and names as in the report"
    return f"there is no hard scene {wanted!r}{meant}"


def _is_called(item: HardScene | Refusal, wanted: str) -> bool:
    return wanted in (item.label, item.name) or (wanted.isdigit() and item.row == int(wanted))


def _is_tried(item: HardScene | Refusal, quick: bool, settings: Sequence[BdptSettings]) -> bool:
    if isinstance(item, Refusal):
        return True
    return not (quick and item.quick is None) and (not settings or any(s in item.settings for s in settings))


def _tried_with(item: HardScene | Refusal) -> str:
    if isinstance(item, Refusal):
        return str(item.settings)
    return " or ".join(map(str, item.settings)) + (", in the long version only" if item.quick is None else "")
