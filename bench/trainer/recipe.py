"""What the settings of the preset `small` are worth: one is changed at a time, at equal processor time.

    PHOTONFARM_SCENES=… python -m bench.trainer.recipe --rooms room night-living-room-2 movable-veach-ajar

Rooms and their stores are those of bench.trainer.guided_networks.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

from bench.harness import results
from bench.trainer.equal_time import COLUMNS, Gap, Result, conditions, measured, parser, write

SMALL = "small"
CHANGED = (
    "schedule=epochs,learning_rate=5e-4",
    "average=0",
    "batch=1",
    "batch=4",
    "learning_rate=5e-4",
    "learning_rate=2e-3",
    "loss=linear",
    "loss=paired",
    "precision=bfloat16",
)
"""Settings as `--set` takes them. The first is the supplement's, with the default decay."""

CANDIDATES: dict[str, dict[str, str]] = {
    SMALL: {},
    **{name: dict(setting.split("=") for setting in name.split(",")) for name in CHANGED},
}


def main() -> None:
    """Render, train and measure; write the page."""
    options = parser(__doc__, CANDIDATES).parse_args()
    chosen = {name: CANDIDATES[name] for name in options.candidates}
    found = {room: measured(room, chosen, options, "recipe") for room in options.rooms}
    write("recipe", page(found, options), found, options)


def page(found: Mapping[str, Sequence[Result]], options: argparse.Namespace) -> str:
    """The tables as Markdown."""
    parts = [
        f"""# What the settings of the recipe are worth

`guided_transport` by the preset `small`, and with one of its settings changed. {conditions(options)} “Above” is how far
above the MSE of `small` it is; the verdict is that of the interval."""
    ]
    for room, each in found.items():
        small = next((result for result in each if result.name == SMALL), None)
        rows = [[f"`{result.name}`", *result.cells(), *_compared(result, small)] for result in each]
        parts += [f"## {room}", results.table(("setting", *COLUMNS, "above", "verdict"), rows)]
    return "\n\n".join(parts)


def _compared(result: Result, small: Result | None) -> tuple[str, str]:
    """Gap and verdict."""
    if small is None or result is small:
        return "–", "–"
    gap = Gap.of(result, small)
    return str(gap), gap.verdict()


if __name__ == "__main__":
    main()
