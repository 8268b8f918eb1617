"""A plan for people to read."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from photonfarm.renderer.strategy.candidate import Candidate
from photonfarm.renderer.strategy.choices import CandidateAtCost, best
from photonfarm.renderer.strategy.comparison import CLEAR, WORTHWHILE, saving
from photonfarm.renderer.strategy.measurement import present
from photonfarm.renderer.strategy.objective.purpose import Purpose
from photonfarm.renderer.strategy.output.table import legend, table
from photonfarm.renderer.strategy.plan import TransportPlan
from photonfarm.renderer.strategy.reasons import BLACK, plus_minus, reasons_for


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
        *(f"  {sentence}" for sentence in (*m.modelled, plan.photons_reason, *_halves(plan), *_beside(plan))),
        "Left out",
        *(f"  {sentence}" for sentence in (*m.left_out, *_unchosen(plan)) or ("nothing",)),
        "Why",
        *(f"  {reason}" for reason in _why(plan)),
        "Measured saving",
        *(f"  {sentence}" for sentence in _savings(plan)),
        "",
        *_measured(plan),
        f"{origin}: {m.views} views of {m.film.width} × {m.film.height} pixels, {m.spp} spp; {m.spent_s:.0f} s of CPU, "
        f"{m.compiling_s:.0f} of them to load, to compile, to time images and to find the weights of pixels",
    ]


def _verdict(plan: TransportPlan) -> str:
    now = present(plan.spec)
    if not plan.at_equal_cost:
        return "nothing was measured: every view is black"
    if plan.candidate == now:
        found = best(_fitting(plan))
        better = "the spec's settings are the best of those measured longest" if found.candidate == now else _NO_GAIN
        return f"{better}: keep them"
    gain = plan.saving(now)
    factor = plus_minus(gain.factor, gain.spread)
    return f"change them: {factor} times as fast to the same error as the spec's settings, {now}"


_NO_GAIN = "no significant gain over the spec's settings"


def _fitting(plan: TransportPlan) -> dict[Candidate, CandidateAtCost]:
    return {c: at_cost for c, at_cost in plan.at_equal_cost.items() if at_cost.fits}


def _halves(plan: TransportPlan) -> list[str]:
    if plan.halves_overhead is None:
        return []
    return [
        f"both half-estimates: they cost at most {plan.halves_overhead:.0%} more than one image of twice the samples, "
        "and without them no error could be measured free of noise"
    ]


def _beside(plan: TransportPlan) -> list[str]:
    m = plan.measurement
    if m.purpose is not Purpose.TRAINING:
        return []
    return [
        f"beside its half-estimates, which share a launch, a sample takes {1e3 * m.configuration_s:.1f} ms for its "
        f"configuration and {1e3 * m.view_s:.1f} ms for its view: buffers, guides, and what it sees"
    ]


def _unchosen(plan: TransportPlan) -> list[str]:
    """The techniques, of light paths and connections, that were measured and are not in the plan."""
    if plan.measurement.left_out or not plan.at_equal_cost:
        return []
    if not plan.candidate.light_ratio:
        return [f"light paths: {_not_better(plan, lambda c: c.light_ratio > 0)}"]
    if not plan.candidate.connections:
        return [f"connections: {_not_better(plan, lambda c: c.connections > 0)}"]
    return []


def _not_better(plan: TransportPlan, has: Callable[[Candidate], bool]) -> str:
    chosen = plan.at_equal_cost[plan.candidate]
    others = [at_cost for at_cost in plan.at_equal_cost.values() if has(at_cost.candidate)]
    if all(saving(chosen, at_cost).deviations >= CLEAR for at_cost in others):
        return "all settings with them take longer to the same error here"
    return "no settings with them that fit the cost are shown to be worth a change"


# --------------------------------------------------------------------------------------------------------------- why


def _why(plan: TransportPlan) -> list[str]:
    if not plan.at_equal_cost:
        return [BLACK]
    rows = _sorted(plan)
    reasons = [*reasons_for(plan.at_equal_cost[plan.candidate], rows, plan.measurement.shared), *_not_taken(plan)]
    now, half_spp = present(plan.spec), plan.spec.transport.half_spp
    if plan.half_spp != half_spp:
        reasons.append(f"half_spp {plan.half_spp} costs about what {half_spp} does with the spec's settings, {now}")
    return reasons


def _not_taken(plan: TransportPlan) -> list[str]:
    """Why the plan does not have the best measured settings, if it does not."""
    reasons = []
    chosen, fitting, any_cost = plan.at_equal_cost[plan.candidate], best(_fitting(plan)), best(dict(plan.at_equal_cost))
    if fitting.candidate != plan.candidate:
        gain = saving(fitting, over=chosen)
        if gain.factor > 1:
            reasons.append(
                f"{fitting.candidate} was measured {plus_minus(gain.factor, gain.spread)} times as fast; less than "
                f"{CLEAR:g} standard errors or {WORTHWHILE:.0%} are not worth a change, after which all samples are "
                "rendered again"
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


def _measured(plan: TransportPlan) -> list[str]:
    """The table, its legend and an empty line each; nothing without a measurement."""
    if not plan.at_equal_cost:
        return []
    purpose = plan.measurement.purpose
    return [*table(_sorted(plan), plan.candidate, purpose), "", *legend(plan.spec, purpose), ""]


def _sorted(plan: TransportPlan) -> list[CandidateAtCost]:
    """The measured settings, in their own order instead of that of the pilot."""
    return sorted(plan.at_equal_cost.values(), key=lambda measured: measured.candidate)
