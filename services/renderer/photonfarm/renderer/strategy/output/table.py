"""The measured settings at equal cost, as a table of text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from photonfarm.renderer.strategy.candidate import Candidate
from photonfarm.renderer.strategy.choices import CandidateAtCost
from photonfarm.renderer.strategy.measurement import present
from photonfarm.renderer.strategy.reasons import rounded
from photonfarm.shared.scene.spec import SceneSpec


def table(offered: Sequence[CandidateAtCost], chosen: Candidate) -> list[str]:
    """A line of heads and one for each candidate."""
    costs = [rounded(offer.relative_cost, offer.spread) for offer in offered]
    means, spreads = (_aligned(part) for part in zip(*costs, strict=True))
    columns = {
        "connections": [str(offer.candidate.connections) for offer in offered],
        "light ratio": _aligned(f"{offer.candidate.light_ratio:g}" for offer in offered),
        "images": [str(offer.errors.images) for offer in offered],
        "half_spp": [str(offer.half_spp) for offer in offered],
        "relMSE": _aligned(_three_digits(offer.half_error) for offer in offered),
        "ms": _aligned(f"{1e3 * offer.time_s:.1f}" for offer in offered),
        "error × time": [
            f"{mean} {'±' if spread.strip() else ' '} {spread}" for mean, spread in zip(means, spreads, strict=True)
        ],
        "": [_remark(offer, chosen) for offer in offered],
    }
    widths = [max(map(len, [head, *cells])) for head, cells in columns.items()]
    rows = [columns, *zip(*columns.values(), strict=True)]
    return ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _remark(offer: CandidateAtCost, chosen: Candidate) -> str:
    if offer.candidate == chosen:
        return "chosen"
    return "" if offer.fits else "too costly"


def legend(spec: SceneSpec) -> list[str]:
    """The meaning of the columns."""
    film, now = spec.film, spec.transport.half_spp
    return [
        "connections: light vertices joined to each eye vertex; light ratio: light paths per eye path; plain path "
        "tracing: 0 and 0; images: rendered to measure it, over all views",
        f"half_spp: samples per pixel, 1 at least, for the time that {now} of the spec's settings take now, "
        f"{present(spec)}; relMSE and ms: relative mean squared error and CPU milliseconds of such a half-estimate, "
        f"{film.width} × {film.height} pixels",
        "error × time: relMSE × ms, relative to plain path tracing, ± one standard error: the time to the same error",
    ]


def _three_digits(value: float) -> str:
    return f"{value:.{min(max(2 - math.floor(math.log10(value)), 0), 6)}f}"


def _aligned(numbers: Iterable[str]) -> list[str]:
    """Numbers padded to one width, their decimal points below each other."""
    parts = [number.partition(".") for number in numbers]
    left, right = (max(len(part[i]) for part in parts) for i in (0, 2))
    return [f"{whole:>{left}}{point or ' ' * bool(right)}{digits:<{right}}" for whole, point, digits in parts]
