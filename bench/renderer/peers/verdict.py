"""What the chosen settings gain over the best unbiased peer, and where they lose to fixed ones."""

from __future__ import annotations

import math
from typing import Any

from bench.harness.results import table
from bench.renderer.peers.chosen import words
from bench.renderer.peers.plans import FIXED, PEERS
from bench.renderer.peers.wording import LABELS, figure, mark

PEERS_EXPLAINED = f"""\
(relMSE × time) of the peer over that of `bdpt`, chosen, above 1 `bdpt` is better; ± as above. The best peer is the one
over which it gains least, of {"; ".join(LABELS[peer] for peer in PEERS)}; one whose mean is marked as off,
‡ or §, is left out.
"""


def verdict(results: list[dict[str, Any]]) -> list[str]:
    """What *chosen* gains over the best unbiased peer, scene by scene, and where it loses to fixed settings."""
    compared = [result for result in results if result["gains"]]
    if not compared:
        return []
    lines = []
    for result in compared:
        best = [best_peer(result, kind) for kind in ("full", "trimmed")]
        cells = [
            f"{figure(result['gains'][peer][kind])} ({LABELS[peer]})" if peer else "–"
            for peer, kind in zip(best, ("full", "trimmed"), strict=True)
        ]
        lines.append((result["line"], *cells))
    won = table(("scene", "all pixels", "trimmed"), lines)
    return ["## `bdpt`, chosen, over the best unbiased peer\n", won, "", PEERS_EXPLAINED, *losses(compared)]


def best_peer(result: dict[str, Any], kind: str) -> str | None:
    """The peer over which *chosen* gains least, of those whose mean is not marked as off."""
    gains = {
        peer: gain["value"]
        for peer in PEERS
        if (gain := result["gains"].get(peer, {}).get(kind))
        and math.isfinite(gain["value"])
        and not mark(peer, result["rows"][peer])
    }
    return min(gains, key=lambda peer: gains[peer], default=None)


def losses(results: list[dict[str, Any]]) -> list[str]:
    """A sentence for each scene and fixed setting of `bdpt` that beats *chosen* by more than the standard error."""
    lines = []
    for result in results:
        for fixed, gains in ((name, gains) for name, gains in result["gains"].items() if name in FIXED):
            if any(gain["value"] + gain["standard_error"] < 1 for gain in gains.values()):
                picked = words(result["chosen"])
                lines.append(
                    f"- In {result['line']} *chosen*, {picked}, is worse than {LABELS[fixed]}: it has "
                    f"{figure(gains['full'])} of its efficiency in all pixels, {figure(gains['trimmed'])} trimmed."
                )
    return [*lines, ""] if lines else ["No fixed setting of `bdpt` beats *chosen* by more than its error.\n"]
