"""The transport settings that a spec should have, with reasons: `photonfarm scene plan`.

`measurement` says what each candidate costs and how much noise it leaves. Here the candidates are compared at the cost
of the present settings, the significantly better ones are chosen, and sentences and tables tell people why. This plan
has nothing to do with the plans of a store, which hold rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from photonfarm.core.waiting import Log
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidates import (
    CLEAR,
    PLAIN,
    WORTHWHILE,
    AtEqualCost,
    Candidate,
    CandidateAtCost,
    Saving,
    best,
    compare_at_cost,
    present_settings,
    saving,
)
from photonfarm.renderer.strategy.content import recommend_photons
from photonfarm.renderer.strategy.measurement import Measurement, find, keep, measure
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import SUSPICIOUS
from photonfarm.scene.spec import PhotonSpec, SceneSpec

SIMILAR = 4.0
"""The factor by which the time of a half-estimate may differ from the measured one, for the measurement to apply.

An image has costs that do not grow with its samples, so the choice depends on half_spp. Settings that --write has put
into the spec take about the same time, so their measurement is found again.
"""

SpecTables = dict[str, dict[str, Any]]
"""The numbers of a spec, by table and key."""


@dataclass(frozen=True, slots=True)
class TransportPlan:
    """The settings a spec should have, given the measurement and the cost that the spec accepts now."""

    spec: SceneSpec
    measurement: Measurement
    cached: bool
    candidate: Candidate  # connections and light ratio
    half_spp: int  # costs about what the spec's settings cost now
    photons: PhotonSpec
    photons_reason: str
    at_equal_cost: AtEqualCost  # all measured ones; empty if every view is black

    @property
    def settings(self) -> SpecTables:
        """The planned tables of the spec. What was measured on a card is for cards alone, but for `half_spp`.

        What a spec does not say of cards they do as processors do. So where it says anything of cards all of it is
        written: a plan for the one then changes nothing for the other.
        """
        transport = self._transport
        if self.measurement.on_card:
            transport = {"half_spp": self.half_spp, "card": self._complete_card(self.candidate)}
        elif self.spec.transport.card is not None:
            on_card = self.spec.model_copy(update={"transport": self.spec.transport.on_card})
            transport["card"] = self._complete_card(present_settings(on_card))
        return {"transport": transport, "photons": {"paths": self.photons.paths, "depth": self.photons.depth}}

    def _complete_card(self, candidate: Candidate) -> dict[str, Any]:
        """The spec's table for cards, with all settings of a candidate."""
        card = self.spec.transport.card
        return {**(card.model_dump(exclude_none=True) if card else {}), **asdict(candidate)}

    @property
    def _transport(self) -> dict[str, Any]:
        """The planned settings of this device; those that the spec need not state are there only where they matter."""
        planned, now = self.candidate, self.spec.transport
        transport = {"connections": planned.connections, "light_ratio": planned.light_ratio, "half_spp": self.half_spp}
        if planned.guided_light or now.guided_light:
            transport["guided_light"] = planned.guided_light
        if planned.light_samples > 1 or now.light_samples > 1:
            transport["light_samples"] = planned.light_samples
        return transport

    @property
    def changes(self) -> SpecTables:
        """The planned tables that differ from the spec's present ones."""
        settings, now = self.settings, {"transport": self.spec.transport, "photons": self.spec.photons}
        planned = {**settings, "transport": self._transport}
        kept = {table: given.model_dump() for table, given in now.items()}
        return {table: settings[table] for table, keys in planned.items() if kept[table] != kept[table] | keys}

    @property
    def saving(self) -> Saving | None:
        """The saving over the spec's settings now; None if the plan keeps them, or nothing was measured."""
        now = present_settings(self.spec)
        if self.candidate == now or not self.at_equal_cost:
            return None
        return saving(self.at_equal_cost[self.candidate], self.at_equal_cost[now])

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        gain = self.saving
        return {
            "scene_id": self.spec.scene_id,
            "for": self.measurement.purpose.value,
            "settings": self.settings,
            "changes": self.changes,
            "saving": gain and {"factor": gain.factor, "spread": gain.spread},
            "cached": self.cached,
            "measurement": self.measurement.model_dump(mode="json"),
        }


def make_plan(
    spec: SceneSpec, beside: Path | None, purpose: Purpose, *, seconds: float, again: bool, log: Log
) -> TransportPlan:
    """The plan of a spec for a purpose; a cached measurement of at least `seconds` is used, unless `again`.

    `beside` is the folder that the spec's files are relative to.
    """
    spec = backend.for_this_device(spec)
    kept = None if again else find(spec, purpose)
    if kept is not None and kept.asked_s >= seconds and has_measured(kept, spec):
        return plan_of(spec, kept, cached=True)
    measurement = measure(spec, beside, purpose, seconds, log)
    try:
        keep(spec, measurement)
    except OSError as error:
        log(f"the measurement could not be kept: {error}")
    return plan_of(spec, measurement, cached=False)


def has_measured(measurement: Measurement, spec: SceneSpec) -> bool:
    """Whether the spec's settings were measured, and at about their cost; if all is black, none need be."""
    cost = measurement.costs.get(present_settings(spec))
    if cost is None:
        return not measurement.rows
    return 1 / SIMILAR <= cost.time_s(spec.transport.half_spp) / measurement.half_s <= SIMILAR


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> TransportPlan:
    """The plan that follows from a measurement for a spec as it is now; its settings are among those measured.

    The plan has the present settings, or others that are significantly better at the same cost. Rounding to a whole
    number of samples changes the cost a little, and at the new cost another candidate may be better still. So the
    search goes on until nothing is better, and a plan made for the result chooses it again. If the search comes back to
    earlier settings, the present ones stay.
    """
    photons = recommend_photons(spec.photons, measurement.reach, spec.transport.max_depth)
    start = present_settings(spec), spec.transport.half_spp
    if not measurement.rows:
        return TransportPlan(spec, measurement, cached, PLAIN, spec.transport.half_spp, *photons, {})
    at_equal_cost, seen = _compare(measurement, *start), [start]
    while (better := _better(measurement, *seen[-1])) is not None:
        if better in seen:
            return TransportPlan(spec, measurement, cached, *seen[0], *photons, at_equal_cost)
        seen.append(better)
    return TransportPlan(spec, measurement, cached, *seen[-1], *photons, at_equal_cost)


def _compare(measurement: Measurement, candidate: Candidate, half_spp: int) -> AtEqualCost:
    """All candidates, at the cost of one with some samples per pixel."""
    return compare_at_cost(measurement.rows, measurement.spp, measurement.costs[candidate].time_s(half_spp))


def _better(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int] | None:
    """The best settings at the cost of these, if they are significantly better; None if not."""
    candidates = _compare(measurement, candidate, half_spp)
    chosen = best(one for one in candidates.values() if one.fits)
    if chosen.candidate == candidate or not saving(chosen, over=candidates[candidate]).significant:
        return None
    return chosen.candidate, chosen.samples


# ------------------------------------------------------------------------------------------------ in words

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
        f"{origin}; it holds for {f'cards ({m.device})' if m.on_card else 'processors'}: {m.views} views of "
        f"{m.film.width} × {m.film.height} pixels, {m.spp} spp; {m.spent_s:.0f} s{'' if m.on_card else ' of CPU'}",
    ]


def _verdict(plan: TransportPlan) -> str:
    now = present_settings(plan.spec)
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
    chosen, now = plan.at_equal_cost[plan.candidate], present_settings(plan.spec)
    reasons = [*reasons_for(chosen, rows, plan.measurement.shared)]
    fastest = best(row for row in rows if row.fits)
    gain = saving(fastest, over=chosen)
    if fastest is not chosen and gain.factor > 1:
        reasons.append(
            f"{fastest.candidate} was measured {plus_minus(gain.factor, gain.spread)} times as fast; less than "
            f"{CLEAR:g} standard errors or {WORTHWHILE:.0%} are not worth a change"
        )
    if plan.half_spp != (half_spp := plan.spec.transport.half_spp):
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

    The place is that of the error's first digit, but tenths for errors of 1 to 10, and whole numbers for larger ones.
    """
    if not spread:
        return f"{value:.3g}"
    places = min(max(-math.floor(math.log10(spread)), int(spread < 10)), 6)
    return f"{value:.{places}f} ± {spread:.{places}f}"


def table(plan: TransportPlan, rows: Sequence[CandidateAtCost]) -> list[str]:
    """A line of heads and one for each candidate."""
    error = "relMSE" if plan.measurement.purpose is Purpose.IMAGES else "loss"
    heads = ("connections", "light ratio", "light samples", "guided", "images", "half_spp", error, "ms", "error × time")
    cells = [(*heads, "")]
    for row in rows:
        settings = row.candidate
        remark = "chosen" if settings == plan.candidate else "" if row.fits else "too costly"
        cells.append(
            (
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
            )
        )
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(f"{cell:>{n}}" for cell, n in zip(line, widths, strict=True)).rstrip() for line in cells]


def legend(plan: TransportPlan) -> list[str]:
    """The meaning of the columns."""
    meaning = "loss: relative loss that noise alone leaves, at the scene's exposure"
    if plan.measurement.purpose is Purpose.IMAGES:
        meaning = "relMSE: relative mean squared error"
    return [
        f"{meaning}, of a half-estimate of half_spp samples per pixel, which takes the time that the spec's settings "
        f"take now, {present_settings(plan.spec)} at half_spp {plan.spec.transport.half_spp}",
        "error × time: relative to plain path tracing over the same views and seeds, ± one standard error; settings of "
        "fewer images were dropped early, and of those that are too costly the time does not pay for one sample",
    ]
