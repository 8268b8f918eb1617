"""A plan for people to read: what is modelled, why it is chosen, in sentences that claim no more than was shown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from photonfarm.renderer.strategy.candidates import (
    CLEAR,
    PLAIN,
    WORTHWHILE,
    Candidate,
    MeasuredCandidate,
    is_alike,
    present,
    saving,
)
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import SUSPICIOUS
from photonfarm.renderer.strategy.plan import CandidateAtCost, TransportPlan, best, fitting
from photonfarm.scene.spec import SceneSpec

BLACK = "every view of the pilot is black: there is no light to model, so plain path tracing does"

ERROR = {Purpose.IMAGES: "relMSE", Purpose.TRAINING: "loss"}
"""The head of the column with errors."""


def lines(plan: TransportPlan) -> list[str]:
    """The settings, the verdict, the modelled content, what is left out, the reasons, the saving, the measurement."""
    m = plan.measurement
    origin = "kept from an earlier measurement (--again measures anew)" if plan.cached else "measured now"
    return [
        f"{plan.spec.name}: connections {plan.candidate.connections}, light_ratio {plan.candidate.light_ratio:g}, "
        f"{'guided_light true, ' * plan.candidate.guided_light}"
        f"{f'light_samples {plan.candidate.light_samples}, ' if plan.candidate.light_samples > 1 else ''}"
        f"half_spp {plan.half_spp}; photons: paths {plan.photons.paths}, depth {plan.photons.depth}",
        f"for {m.purpose}: {_verdict(plan)}",
        "",
        "Modelled",
        *(f"  {sentence}" for sentence in (*m.modelled, plan.photons_reason)),
        "Left out",
        *(f"  {sentence}" for sentence in m.left_out or ("nothing",)),
        "Why",
        *(f"  {reason}" for reason in _why(plan)),
        "Measured saving",
        *(f"  {sentence}" for sentence in _savings(plan)),
        "",
        *_describe_measurement(plan),
        f"{origin}: {m.views} views of {m.film.width} × {m.film.height} pixels, {m.spp} spp; {m.spent_s:.0f} s of CPU",
    ]


def _verdict(plan: TransportPlan) -> str:
    now = present(plan.spec)
    if not plan.at_equal_cost:
        return "nothing was measured: every view is black"
    if plan.candidate == now:
        chosen = best(fitting(plan.at_equal_cost))
        better = (
            "the spec's settings are the best of those measured longest"
            if chosen.candidate == now
            else "no significant gain over the spec's settings"
        )
        return f"{better}: keep them"
    gain = plan.saving(now)
    factor = plus_minus(gain.factor, gain.spread)
    return f"change them: {factor} times as fast to the same error as the spec's settings, {now}"


def _why(plan: TransportPlan) -> list[str]:
    if not plan.at_equal_cost:
        return [BLACK]
    rows = _sort_rows(plan)
    reasons = [*reasons_for(plan.at_equal_cost[plan.candidate], rows, plan.measurement.shared), *_not_taken(plan)]
    now, half_spp = present(plan.spec), plan.spec.transport.half_spp
    if plan.half_spp != half_spp:
        reasons.append(f"half_spp {plan.half_spp} costs about what {half_spp} does with the spec's settings, {now}")
    return reasons


def _not_taken(plan: TransportPlan) -> list[str]:
    """Why the plan does not have the best measured settings, if it does not."""
    reasons = []
    chosen, cheap, any_cost = (
        plan.at_equal_cost[plan.candidate],
        best(fitting(plan.at_equal_cost)),
        best(plan.at_equal_cost),
    )
    if cheap.candidate != plan.candidate:
        gain = saving(cheap, over=chosen)
        if gain.factor > 1:
            reasons.append(
                f"{cheap.candidate} was measured {plus_minus(gain.factor, gain.spread)} times as fast; less than "
                f"{CLEAR:g} standard errors or {WORTHWHILE:.0%} are not worth a change"
            )
    gain = saving(any_cost, over=chosen)
    if not any_cost.fits and gain.significant:
        reasons.append(
            f"one sample of {any_cost.candidate} costs more than a half-estimate does now; a larger half_spp allows "
            f"it, which reaches the same error {plus_minus(gain.factor, gain.spread)} times as fast"
        )
    return reasons


def _savings(plan: TransportPlan) -> Sequence[str]:
    now = present(plan.spec)
    if plan.savings:
        return [
            f"{plus_minus(gain.factor, gain.spread)} times as fast to the same error as {gain.over}"
            + (", the spec's settings now" if gain.over == now else "")
            for gain in plan.savings
        ]
    return ["none: the spec has these settings already" if plan.candidate == now else "none: nothing to compare with"]


def _describe_measurement(plan: TransportPlan) -> list[str]:
    """The table, its legend and an empty line each; nothing without a measurement."""
    if not plan.at_equal_cost:
        return []
    purpose = plan.measurement.purpose
    return [*table(_sort_rows(plan), plan.candidate, purpose), "", *legend(plan.spec, purpose), ""]


def _sort_rows(plan: TransportPlan) -> list[CandidateAtCost]:
    """The measured settings, in their own order instead of that of the pilot."""
    return sorted(plan.at_equal_cost.values(), key=lambda measured: measured.candidate)


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
    return " ± ".join(filter(None, round_with_error(value, spread)))


def round_with_error(value: float, spread: float | None) -> tuple[str, str]:
    """A value and its standard error to the same decimal place; the second is empty if it is None.

    The place is that of the error's first digit, but tenths for errors of 1 to 10 and ones above.
    """
    if not spread:
        return f"{value:.3g}", ""
    places = min(max(-math.floor(math.log10(spread)), int(spread < 10)), 6)
    return f"{value:.{places}f}", f"{spread:.{places}f}"


# ------------------------------------------------------------------------------------------------ the table


def table(candidates: Sequence[CandidateAtCost], chosen: Candidate, purpose: Purpose) -> list[str]:
    """A line of heads and one for each candidate."""
    costs = [round_with_error(measured.relative_cost, measured.spread) for measured in candidates]
    means, spreads = (_align(part) for part in zip(*costs, strict=True))
    columns = {
        "connections": [str(measured.candidate.connections) for measured in candidates],
        "light ratio": _align(f"{measured.candidate.light_ratio:g}" for measured in candidates),
        "light samples": [str(measured.candidate.light_samples) for measured in candidates],
        "guided": ["yes" if measured.candidate.guided_light else "no" for measured in candidates],
        "images": [str(measured.errors.images) for measured in candidates],
        "half_spp": [str(measured.half_spp) for measured in candidates],
        ERROR[purpose]: _align(_three_digits(measured.half_error) for measured in candidates),
        "ms": _align(f"{1e3 * measured.time_s:.1f}" for measured in candidates),
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
        f"error × time: {error} × ms, relative to plain path tracing over the same views and seeds, ± "
        "one standard error: the time to the same error; too costly: the time does not pay for one sample per pixel",
    ]


_MEANING = {
    Purpose.IMAGES: "relative mean squared error",
    Purpose.TRAINING: "relative loss that noise alone leaves, at the scene's exposure,",
}


def _three_digits(value: float) -> str:
    return f"{value:.{min(max(2 - math.floor(math.log10(value)), 0), 6)}f}" if value > 0 else "0"


def _align(numbers: Iterable[str]) -> list[str]:
    """Numbers padded to one width, their decimal points below each other."""
    parts = [number.partition(".") for number in numbers]
    left, right = (max(len(part[i]) for part in parts) for i in (0, 2))
    return [f"{whole:>{left}}{point or ' ' * bool(right)}{digits:<{right}}" for whole, point, digits in parts]
