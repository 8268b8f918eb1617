"""Why a candidate is chosen, in sentences that claim no more than was shown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from photonfarm.renderer.strategy.candidate import PLAIN
from photonfarm.renderer.strategy.comparison import CLEAR, MeasuredCandidate, is_alike

BLACK = "every view of the pilot is black: there is no light to model, so plain path tracing does"

SUSPICIOUS = 0.05
"""The share of missed light in a candidate's error above which it is examined and reported."""


def reasons_for(chosen: MeasuredCandidate, rows: Sequence[MeasuredCandidate], shared: float) -> tuple[str, ...]:
    """The reasons for choosing a candidate among all that were measured.

    `shared` is the error of one image from rare bright samples that all candidates share (see `noise`).
    """
    reasons = [_against_plain(chosen, rows)]
    if alike := [str(row.candidate) for row in rows if row is not chosen and is_alike(row, chosen)]:
        reasons.append(f"not distinguishable from it, within {CLEAR:g} standard errors: {'; '.join(alike)}")
    reasons += [
        f"{row.candidate} misses light that others find: {row.missed / row.error:.0%} of its error is inferred from "
        "that, and the true one may be larger"
        for row in rows
        if row.missed > (SUSPICIOUS if row is chosen else 0.5) * row.error
    ]
    if shared > 0.5 * chosen.error:
        reasons.append(
            "rare bright samples that all settings compared have in common are left out of the comparison: they add "
            f"about {shared:.2g} to the error of an image, which is {chosen.error:.2g} without them"
        )
    return tuple(reasons)


def _against_plain(chosen: MeasuredCandidate, rows: Sequence[MeasuredCandidate]) -> str:
    if chosen.candidate != PLAIN:
        share = plus_minus(chosen.relative_cost, chosen.spread)
        return f"{chosen.candidate} reaches the error of {PLAIN} in {share} of the time"
    if not rows[1:]:
        return f"{PLAIN}: there is nothing else to compare it with"
    return f"{PLAIN}: nothing else that fits its cost is shown to reach its error sooner"


def plus_minus(value: float, spread: float | None) -> str:
    """A value and its standard error, "0.34 ± 0.02", rounded by `rounded`."""
    return " ± ".join(filter(None, rounded(value, spread)))


def rounded(value: float, spread: float | None) -> tuple[str, str]:
    """A value and its standard error to the same decimal place; the second is empty if it is None.

    The place is that of the error's first digit, but tenths for errors of 1 to 10 and ones above.
    """
    if not spread:
        return f"{value:.3g}", ""
    places = min(max(-math.floor(math.log10(spread)), int(spread < 10)), 6)
    return f"{value:.{places}f}", f"{spread:.{places}f}"
