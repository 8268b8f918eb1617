"""What each part of the guided networks is worth, at equal processor time, and what was tried and not kept.

Every candidate is trained by the recipe of the preset `small` for as many steps as fit the same seconds.

    PHOTONFARM_SCENES=… python -m bench.trainer.guided_networks --rooms room night-living-room-2 movable-veach-ajar

A room is a built-in spec, or an experiment of experiments/ in its small size, whose store it shares.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Mapping, Sequence

from bench.harness import results
from bench.trainer import candidates
from bench.trainer.equal_time import COLUMNS, Gap, Result, conditions, measured, parser, write

KEPT = (
    "cnn", "light_transport", "light_transport_photons",
    "guided", "guided_transport", "guided_photons", "guided_transport_photons",
)  # fmt: skip
WITHOUT = {
    "guided": ("cnn",),
    "guided_transport": ("guided",),
    "guided_photons": ("guided",),
    "guided_transport_photons": ("guided_photons", "guided_transport"),
}
"""What each is compared with: itself without a part."""

TRIED = {
    candidates.OneBounce: "guided_transport",
    candidates.TwoBounces: "guided_transport",
    candidates.Unhidden: "guided_transport",
    candidates.Attention: "guided_transport",
    candidates.LatentTokens: "guided_transport",
    candidates.MaximumBeside: "guided_transport",
    candidates.FilledProjection: "light_transport",
}
"""What was not kept, and the network that was instead."""

INSTEAD = {kind.__name__: kept for kind, kept in TRIED.items()}
CANDIDATES: dict[str, Mapping[str, str]] = {
    **{name: {"architecture": name} for name in KEPT},
    **{name: {"architecture": f"{candidates.__name__}:{name}"} for name in INSTEAD},
}


def main() -> None:
    """Render, train and measure; write the page."""
    options = parser(__doc__, CANDIDATES).parse_args()
    chosen = {name: CANDIDATES[name] for name in options.candidates}
    found = {room: measured(room, chosen, options, "guided_networks") for room in options.rooms}
    write("guided_networks", page(found, options), found, options)


def page(found: Mapping[str, Sequence[Result]], options: argparse.Namespace) -> str:
    """The tables as Markdown."""
    parts = [
        f"""# What the parts of guided networks are worth

{conditions(options)} “Without” is how far above its MSE the same network without a part is.

Tried and not kept, with how far their MSE is above that of the network that was kept:""",
        results.table(("network", "what it is"), [(kind.__name__, inspect.getdoc(kind)) for kind in TRIED]),
    ]
    for room, each in found.items():
        parts += [f"## {room}", *tables({result.name: result for result in each})]
    return "\n\n".join(parts)


def tables(by_name: Mapping[str, Result]) -> list[str]:
    """Those of a room: what is kept, and what was tried."""
    kept = [[name, *result.cells(), _without(name, by_name)] for name, result in by_name.items() if name in KEPT]
    tried = [[name, *by_name[name].cells(), _above(name, by_name)] for name in INSTEAD if name in by_name]
    made = [results.table(("network", *COLUMNS, "without"), kept)] if kept else []
    return [*made, results.table(("tried, not kept", *COLUMNS, "above"), tried)] if tried else made


def _without(name: str, by_name: Mapping[str, Result]) -> str:
    less = [by_name[other] for other in WITHOUT.get(name, ()) if other in by_name]
    return "; ".join(f"{without.name} {Gap.of(without, by_name[name])}" for without in less) or "–"


def _above(name: str, by_name: Mapping[str, Result]) -> str:
    kept = by_name.get(INSTEAD[name])
    return f"{kept.name} {Gap.of(by_name[name], kept)}" if kept else "–"


if __name__ == "__main__":
    main()
