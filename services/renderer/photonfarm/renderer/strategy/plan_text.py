"""A plan for people to read: what is modelled, why it is chosen, in sentences that claim no more than was shown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from photonfarm.renderer.strategy.candidates import (
    CLEAR,
    PLAIN,
    WORTHWHILE,
    CandidateAtCost,
    best,
    present,
    saving,
)
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import SUSPICIOUS
from photonfarm.renderer.strategy.plan import TransportPlan

BLACK = "every view of the pilot is black: there is no light to model, so plain path tracing does"


def lines(plan: TransportPlan) -> list[str]:
    """The settings, the verdict, the modelled content, what is left out, the reasons, the measurement."""
    m, rows = plan.measurement, sorted(plan.at_equal_cost.values(), key=lambda row: row.candidate)
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
        *(f"  {reason}" for reason in _why(plan, rows)),
        "",
        *([*table(plan, rows), "", *legend(plan), ""] if rows else []),
        f"{origin}: {m.views} views of {m.film.width} × {m.film.height} pixels, {m.spp} spp; {m.spent_s:.0f} s of CPU",
    ]


def _verdict(plan: TransportPlan) -> str:
    now = present(plan.spec)
    if not plan.at_equal_cost:
        return "nothing was measured: every view is black"
    if gain := plan.saving:
        factor = plus_minus(gain.factor, gain.spread)
        return f"change them: {factor} times as fast to the same error as the spec's settings, {now}"
    if best(row for row in plan.at_equal_cost.values() if row.fits).candidate == now:
        return "the spec's settings are the best of those measured longest: keep them"
    return "no significant gain over the spec's settings: keep them"


def _why(plan: TransportPlan, rows: Sequence[CandidateAtCost]) -> list[str]:
    """The reasons for the plan, and why it does not have the best measured settings, if it does not."""
    if not rows:
        return [BLACK]
    chosen, now, half_spp = plan.at_equal_cost[plan.candidate], present(plan.spec), plan.spec.transport.half_spp
    reasons = [*reasons_for(chosen, rows, plan.measurement.shared)]
    fastest = best(row for row in rows if row.fits)
    gain = saving(fastest, over=chosen)
    if fastest is not chosen and gain.factor > 1:
        reasons.append(
            f"{fastest.candidate} was measured {plus_minus(gain.factor, gain.spread)} times as fast; less than "
            f"{CLEAR:g} standard errors or {WORTHWHILE:.0%} are not worth a change"
        )
    if plan.half_spp != half_spp:
        reasons.append(f"half_spp {plan.half_spp} costs about what {half_spp} does with the spec's settings, {now}")
    return reasons


def reasons_for(chosen: CandidateAtCost, rows: Sequence[CandidateAtCost], shared: float) -> list[str]:
    """The reasons for choosing a candidate among all that were measured.

    `shared` is the error of one image from rare bright samples that all candidates share (see `noise`).
    """
    if chosen.candidate != PLAIN:
        share = plus_minus(chosen.relative_cost, chosen.spread)
        reasons = [f"{chosen.candidate} reaches the error of {PLAIN} in {share} of the time"]
    elif not rows[1:]:
        reasons = [f"{PLAIN}: there is nothing else to compare it with"]
    else:
        reasons = [f"{PLAIN}: nothing else that fits its cost is shown to reach its error sooner"]
    others = [row for row in rows if row is not chosen]
    if alike := [str(row.candidate) for row in others if abs(saving(row, chosen).deviations) < CLEAR]:
        reasons.append(f"not distinguishable from it, within {CLEAR:g} standard errors: {'; '.join(alike)}")
    reasons += [
        f"{row.candidate} misses light that others find: {row.missed / row.errors.mean:.0%} of its error is inferred "
        "from that, and the true one may be larger"
        for row in rows
        if row.missed > (SUSPICIOUS if row is chosen else 0.5) * row.errors.mean
    ]
    if shared > 0.5 * chosen.errors.mean:
        reasons.append(
            "rare bright samples that all settings compared have in common are left out of the comparison: they add "
            f"about {shared:.2g} to the error of an image, which is {chosen.errors.mean:.2g} without them"
        )
    return reasons


def plus_minus(value: float, spread: float | None) -> str:
    """A value and its standard error, "0.34 ± 0.02", to the same decimal place; the value alone without an error.

    The place is that of the error's first digit, but tenths for errors of 1 to 10 and ones above.
    """
    if not spread:
        return f"{value:.3g}"
    places = min(max(-math.floor(math.log10(spread)), int(spread < 10)), 6)
    return f"{value:.{places}f} ± {spread:.{places}f}"


# ------------------------------------------------------------------------------------------------ the table


def table(plan: TransportPlan, rows: Sequence[CandidateAtCost]) -> list[str]:
    """A line of heads and one for each candidate."""
    error = "relMSE" if plan.measurement.purpose is Purpose.IMAGES else "loss"
    heads = ("connections", "light ratio", "light samples", "guided", "images", "half_spp", error, "ms", "error × time")
    cells = [(*heads, "")]
    for row in rows:
        settings = row.candidate
        remark = "chosen" if settings == plan.candidate else "" if row.fits else "too costly"
        cells.append((
            str(settings.connections),
            f"{settings.light_ratio:g}",
            str(settings.light_samples),
            "yes" if settings.guided_light else "no",
            str(row.errors.images),
            str(row.samples),
            f"{row.error:.3g}",
            f"{1e3 * row.time_s:.1f}",
            plus_minus(row.relative_cost, row.spread),
            remark,
        ))  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(f"{cell:>{n}}" for cell, n in zip(line, widths, strict=True)).rstrip() for line in cells]


def legend(plan: TransportPlan) -> list[str]:
    """The meaning of the columns."""
    spec, error, meaning = plan.spec, "relMSE", "relative mean squared error"
    if plan.measurement.purpose is Purpose.TRAINING:
        error, meaning = "loss", "relative loss that noise alone leaves, at the scene's exposure,"
    return [
        "images: rendered to measure it, over all views; settings with fewer of them were dropped early and cannot be "
        "chosen",
        f"half_spp: samples per pixel, 1 at least, for the time that {spec.transport.half_spp} of the spec's settings "
        f"take now, {present(spec)}; {error} and ms: {meaning} and CPU milliseconds of such a half-estimate, "
        f"{spec.film.width} × {spec.film.height} pixels",
        f"error × time: {error} × ms, relative to plain path tracing over the same views and seeds, ± one standard "
        "error: the time to the same error; too costly: the time does not pay for one sample per pixel",
    ]
