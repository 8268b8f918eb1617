"""The 36 rows, in order."""

from __future__ import annotations

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


def choose(
    only: Sequence[str] = (), *, quick: bool = False, settings: Sequence[BdptSettings] = ()
) -> list[HardScene | Refusal]:
    """Scenes and refusals by row number, name or label, in order; all of them for an empty choice.

    Scenes without a quick version, or not tried with any of the settings, are left out. Raises ValueError for a name
    that matches no scene, or if none is left.
    """

    def is_called(item: HardScene | Refusal, wanted: str) -> bool:
        return wanted in (item.label, item.name) or (wanted.isdigit() and item.row == int(wanted))

    def is_tried(item: HardScene | Refusal) -> bool:
        if isinstance(item, Refusal):
            return True
        return not (quick and item.quick is None) and (not settings or any(s in item.settings for s in settings))

    everything: list[HardScene | Refusal] = sorted([*SCENES, *REFUSALS], key=lambda item: item.row or ROWS + 1)
    left = list(filter(is_tried, everything))
    for wanted in only:
        if not any(is_called(item, wanted) for item in everything):
            raise ValueError(f"there is no hard scene {wanted!r}; allowed are the rows 1 to {ROWS} and their names")
        if not any(is_called(item, wanted) for item in left):
            raise ValueError(f"{wanted} is not tried with these settings, or has no quick version")
    return [item for item in left if not only or any(is_called(item, wanted) for wanted in only)]
