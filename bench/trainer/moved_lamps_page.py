"""The page and the figures of moved_lamps.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.harness import results, room_study
from bench.harness.network_errors import Errors
from bench.trainer.explained import Change, Explained

KNOWN = "light known alone"


@dataclass(frozen=True, slots=True)
class ExplainedChange:
    """What a candidate explains."""

    name: str
    seeds: tuple[int, ...]
    whole: Explained  # of whole images
    stays: Explained  # of the pixels that show one surface in both


@dataclass(frozen=True, slots=True)
class LampStudy:
    """What was measured of a room."""

    name: str
    lamps: tuple[str, ...]
    change: Change
    rows: tuple[ExplainedChange, ...]


def stated(explained: Explained) -> str:
    """R² and its 95 % interval."""
    low, high = explained.interval()
    return f"{explained.share:.3f} ({low:.3f} … {high:.3f})"


def each_seed(explained: Explained) -> str:
    """R² of each seed, and their standard deviation; empty from one seed."""
    found = explained.of_seeds()
    if len(found) == 1:
        return ""
    return f"{' · '.join(f'{share:.3f}' for share in found)}; s = {found.std(ddof=1):.3f}"


def part(room: LampStudy) -> str:
    """What a page says of a room."""
    header = ("", "R² (95 %)", "of each seed", "R² on surfaces that stay in view (95 %)", "of each seed")
    lines = [
        [row.name, stated(row.whole), each_seed(row.whole), stated(row.stays), each_seed(row.stays)]
        for row in room.rows
    ]
    whole, same = (errors.of_seeds()[0] / 2 for errors in room.change.there())
    return f"""## {room.name}

Lamps that move: {", ".join(room.lamps)}. {room_study.counted(len(room.change.units), "view")}. What the lamps change is
{whole:.5f}, half the mean squared difference, of which {same:.5f} lie on surfaces that stay in view,
{room.change.stays.mean():.0%} of the pixels.

{results.table(header, lines)}"""


def page(rooms: Sequence[LampStudy], half_spp: int) -> str:
    """The tables as Markdown."""
    parts = "\n\n".join(part(room) for room in rooms)
    return f"""# How much of what moved lamps change networks explain

Held-out views, each rendered as it is and with its lamps as in another random configuration, objects as they were; the
networks of the experiments, as they were trained, predict both. With Δ the change of a pixel in the metric space,
clip(exposure · I, 0, 1)^(1/2.2), and p the predicted one, R² = 1 − Σ (p − Δ)² / Σ Δ², sums over pixels, channels and
views: 1 explains all, 0 is a prediction that does not change, and below 0 one that changes to the worse. The noise of
the references is taken out by their halves of {half_spp} spp, but for what that curve makes of it; that of a network's
own inputs, such as photons and direct light, counts against it, and may be more than all that lamps change where most
of the light is not theirs.

**Surfaces that stay in view** are pixels that show one surface in both, by depth, normal and albedo, and so no lamp
that moved; a mirror stays, whatever it shows. **{KNOWN.capitalize()}** is emission, direct light and gloss of the
guides: nothing in it is learned. Intervals are of a bootstrap over configurations, for these networks, and rough where
few views carry the sums; seeds of one network are averaged, and s is their standard deviation. Denoisers are left out:
they are given an image of that same view.

{parts}"""


def document(rooms: Sequence[LampStudy]) -> dict[str, Any]:
    """The figures of moved_lamps.json; of each view, what is there and what is left, as shares of all pixels."""
    return {
        room.name: {
            "lamps": room.lamps,
            "units": [unit.hex() for unit in room.change.units],
            "stays": room.change.stays.mean(axis=(1, 2)).round(4).tolist(),
            "there": dict(zip(("whole", "stays"), map(_rounded, room.change.there()), strict=True)),
            "rows": [
                {"name": row.name, "seeds": row.seeds, "whole": _figures(row.whole), "stays": _figures(row.stays)}
                for row in room.rows
            ],
        }
        for room in rooms
    }


def _figures(explained: Explained) -> dict[str, Any]:
    """R², its interval, and what it is made of; None for −∞."""
    low, high = explained.interval()
    found = explained.share, low, high, *explained.of_seeds()
    share, *others = (round(float(value), 5) if np.isfinite(value) else None for value in found)
    return {
        "r2": share, "interval_95": others[:2], "r2_of_seeds": others[2:], "left": _rounded(explained.left)
    }  # fmt: skip


def _rounded(errors: Errors) -> list[list[float]]:
    return np.round(errors.values, 8).tolist()
