"""The measured settings at equal cost, as a table of text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from photonfarm.renderer.strategy.candidate import Candidate
from photonfarm.renderer.strategy.choices import CandidateAtCost
from photonfarm.renderer.strategy.measurement import present
from photonfarm.renderer.strategy.objective.purpose import Purpose
from photonfarm.renderer.strategy.reasons import rounded
from photonfarm.shared.scene.spec import SceneSpec

ERROR = {Purpose.IMAGES: "relMSE", Purpose.TRAINING: "loss"}
"""The head of the column with errors."""


def table(candidates: Sequence[CandidateAtCost], chosen: Candidate, purpose: Purpose) -> list[str]:
    """A line of heads and one for each candidate."""
    costs = [rounded(measured.relative_cost, measured.spread) for measured in candidates]
    means, spreads = (_aligned(part) for part in zip(*costs, strict=True))
    columns = {
        "connections": [str(measured.candidate.connections) for measured in candidates],
        "light ratio": _aligned(f"{measured.candidate.light_ratio:g}" for measured in candidates),
        "light samples": [str(measured.candidate.light_samples) for measured in candidates],
        "guided": ["yes" if measured.candidate.guided_light else "no" for measured in candidates],
        "images": [str(measured.errors.images) for measured in candidates],
        "half_spp": [str(measured.half_spp) for measured in candidates],
        ERROR[purpose]: _aligned(_three_digits(measured.half_error) for measured in candidates),
        "ms": _aligned(f"{1e3 * measured.time_s:.1f}" for measured in candidates),
        "error × time": [
            f"{mean} {'±' if spread.strip() else ' '} {spread}" for mean, spread in zip(means, spreads, strict=True)
        ],
        "": [_remark(measured, chosen) for measured in candidates],
    }
    widths = [max(map(len, [head, *cells])) for head, cells in columns.items()]
    rows = [columns, *zip(*columns.values(), strict=True)]
    return ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _remark(measured: CandidateAtCost, chosen: Candidate) -> str:
    if measured.candidate == chosen:
        return "chosen"
    return "" if measured.fits else "too costly"


def legend(spec: SceneSpec, purpose: Purpose) -> list[str]:
    """The meaning of the columns."""
    error = ERROR[purpose]
    film, now = spec.film, spec.transport.half_spp
    return [
        "connections: light vertices joined to each of the first two eye vertices; light ratio: light paths per eye "
        "path; plain path tracing: 0 and 0; light samples: of next event estimation at the first eye vertex; guided: "
        "light paths start where they reach what is seen, and connections go to useful light vertices; images: "
        "rendered to measure it, over all views; settings with fewer of them than others were dropped early and "
        "cannot be chosen",
        f"half_spp: samples per pixel, 1 at least, for the time that {now} of the spec's settings take now, "
        f"{present(spec)}; {error} and ms: {_MEANING[purpose]} and CPU milliseconds of such a half-estimate, "
        f"{film.width} × {film.height} pixels",
        f"error × time: {error} × {_TIME[purpose]}, relative to plain path tracing over the same views and seeds, ± "
        "one standard error: the time to the same error; too costly: the time does not pay for one sample per pixel",
    ]


_MEANING = {
    Purpose.IMAGES: "relative mean squared error",
    Purpose.TRAINING: "relative loss that noise alone leaves, at the scene's exposure,",
}
_TIME = {Purpose.IMAGES: "ms", Purpose.TRAINING: "(ms + half of what a sample takes beside its half-estimates)"}


def _three_digits(value: float) -> str:
    return f"{value:.{min(max(2 - math.floor(math.log10(value)), 0), 6)}f}" if value > 0 else "0"


def _aligned(numbers: Iterable[str]) -> list[str]:
    """Numbers padded to one width, their decimal points below each other."""
    parts = [number.partition(".") for number in numbers]
    left, right = (max(len(part[i]) for part in parts) for i in (0, 2))
    return [f"{whole:>{left}}{point or ' ' * bool(right)}{digits:<{right}}" for whole, point, digits in parts]
