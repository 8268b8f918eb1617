"""A plan for people to read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from photonfarm.renderer.strategy.measurement import present
from photonfarm.renderer.strategy.pilot import plus_minus, rounded
from photonfarm.renderer.strategy.plan import Plan


def lines(plan: Plan) -> list[str]:
    """What is modelled, what is left out, why, what that saves, and the measurement it rests on."""
    m = plan.measurement
    origin = "kept from an earlier pilot (--again measures anew)" if plan.cached else "measured now"
    return [
        f"{plan.spec.name}: connections {plan.candidate.connections}, light_ratio {plan.candidate.light_ratio:g}, "
        f"half_spp {plan.half_spp}; photons: paths {plan.photons.paths}, depth {plan.photons.depth}",
        "",
        "Modelled",
        *(f"  {sentence}" for sentence in m.modelled),
        f"  {plan.photons_reason}",
        f"  both half-estimates: they cost {plan.halves_overhead:.0%} more than one image of twice the samples, and "
        "without them no error could be measured free of noise",
        "Left out",
        *(f"  {sentence}" for sentence in (*m.left_out, *_unchosen(plan)) or ("nothing",)),
        "Why",
        *(f"  {reason}" for reason in (*m.reasons, *_from_cost(plan))),
        "Measured saving",
        *(f"  {saving}" for saving in _savings(plan)),
        "",
        *_table(plan),
        f"{origin}: {m.views} views of {m.film.width} × {m.film.height} pixels, {m.spp} spp; {m.spent_s:.0f} s of CPU, "
        f"{m.compiling_s:.0f} of them to load, to compile and to weight the images",
    ]


def _unchosen(plan: Plan) -> list[str]:
    if plan.measurement.left_out or not plan.measurement.rows:
        return []
    if not plan.candidate.light_ratio:
        return ["light paths: no ratio of them pays here"]
    if not plan.candidate.connections:
        return ["connections: light paths that are joined to the camera alone reach the same error sooner"]
    return []


def _from_cost(plan: Plan) -> list[str]:
    """What follows from the cost that the spec accepts now."""
    best, now = plan.measurement.candidate, plan.spec.transport.half_spp
    reasons = []
    if plan.candidate != best and plan.measurement.rows:
        reasons.append(
            f"but one sample of {best} costs more than a half-estimate does now, so {plan.candidate} is taken; "
            "a larger half_spp allows the best"
        )
    if plan.half_spp != now:
        reasons.append(f"half_spp {plan.half_spp} costs what {now} does with the spec's settings, {present(plan.spec)}")
    return reasons


def _savings(plan: Plan) -> Sequence[str]:
    now = present(plan.spec)
    if plan.savings:
        return [
            f"{plus_minus(saving.factor, saving.spread)} times as fast to the same error as {saving.over}"
            + (", the spec's settings now" if saving.over == now else "")
            for saving in plan.savings
        ]
    return ["none: the spec has these settings already" if plan.candidate == now else "none: nothing to compare with"]


# ---------------------------------------------------------------------------------------------------------- the table


def _table(plan: Plan) -> list[str]:
    """The measured settings, a legend and an empty line; nothing where nothing was measured."""
    m = plan.measurement
    if not m.rows:
        return []
    costs = [rounded(row.relative_cost, row.spread) for row in m.rows]
    means, spreads = (_aligned(part) for part in zip(*costs, strict=True))
    columns = {
        "connections": [str(row.connections) for row in m.rows],
        "light ratio": _aligned(f"{row.light_ratio:g}" for row in m.rows),
        "images": [str(row.images) for row in m.rows],
        "relMSE": _aligned(_three_digits(row.error) for row in m.rows),
        "ms": _aligned(f"{1e3 * row.time_s(m.half_spp):.1f}" for row in m.rows),
        "error × time": [
            f"{mean} {'±' if spread.strip() else ' '} {spread}" for mean, spread in zip(means, spreads, strict=True)
        ],
        "": ["chosen" if row.candidate == plan.candidate else "" for row in m.rows],
    }
    widths = [max(map(len, [head, *cells])) for head, cells in columns.items()]
    rows = [columns, *zip(*columns.values(), strict=True)]
    table = ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [*table, "", *_legend(plan), ""]


def _legend(plan: Plan) -> list[str]:
    m, film = plan.measurement, plan.spec.film
    return [
        "connections: light vertices joined to each eye vertex; light ratio: light paths per eye path; plain path "
        "tracing: 0 and 0; images: rendered to measure it, over all views",
        f"relMSE: relative mean squared error of an image of {m.spp} spp; ms: CPU milliseconds of one half-estimate, "
        f"{film.width} × {film.height} pixels of {m.half_spp} spp",
        "error × time: relMSE × ms, relative to plain path tracing, ± one standard error: the time to the same error",
    ]


def _three_digits(value: float) -> str:
    return f"{value:.{min(max(2 - math.floor(math.log10(value)), 0), 6)}f}"


def _aligned(numbers: Iterable[str]) -> list[str]:
    """Numbers padded to one width, their decimal points below each other."""
    parts = [number.partition(".") for number in numbers]
    left, right = (max(len(part[i]) for part in parts) for i in (0, 2))
    return [f"{whole:>{left}}{point or ' ' * bool(right)}{digits:<{right}}" for whole, point, digits in parts]
