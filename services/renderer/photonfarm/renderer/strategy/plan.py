"""The plan of a spec's light transport, with reasons: `photonfarm scene plan`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from photonfarm.core.waiting import Log
from photonfarm.renderer.strategy.candidates import (
    DEFAULT,
    PLAIN,
    Candidate,
    MeasuredCandidate,
    Saving,
    present,
    saving,
)
from photonfarm.renderer.strategy.content import recommend_photons
from photonfarm.renderer.strategy.measurement import CandidateRow, Measurement, find, keep, measure
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import longest
from photonfarm.scene.spec import PhotonSpec, SceneSpec

SIMILAR = 4.0
"""The factor between times of half-estimates up to which a measurement still applies.

The choice depends on an image's fixed part, which matters if samples are few. A written plan keeps the time, up to a
sample.
"""

SpecTables = Mapping[str, Mapping[str, int | float]]
"""The numbers of a spec, by table and key."""

# -------------------------------------------------------------------------------------------- at equal cost


@dataclass(frozen=True, slots=True)
class CandidateAtCost(MeasuredCandidate):
    """A candidate with the samples per pixel that fit the time; `time_s` is the time of such a half-estimate."""

    half_spp: int
    half_error: float  # of such a half-estimate: relMSE, or relative loss (see `noise`)
    fits: bool  # whether at least about one sample per pixel fits the time


def candidates_at_equal_cost(measurement: Measurement, half_s: float) -> dict[Candidate, CandidateAtCost]:
    """Every measured candidate, at the samples per pixel that fit `half_s`.

    The variance of an image is that of one sample over the number of samples n. So error × time is the error of one
    sample × time / n.
    """
    return {row.candidate: _settings_at_cost(row, measurement, half_s) for row in measurement.rows}


def _settings_at_cost(row: CandidateRow, measurement: Measurement, half_s: float) -> CandidateAtCost:
    plain, samples = measurement.row(PLAIN), row.cost.bought(half_s)
    cost = row.errors.ratio * row.cost.per_sample_s(half_s) / plain.cost.per_sample_s(half_s)
    relative = row.errors.relative_spread(plain.errors)
    return CandidateAtCost(
        candidate=row.candidate,
        errors=row.errors,
        missed=row.missed,
        time_s=row.cost.time_s(samples),
        relative_cost=cost,
        spread=None if relative is None else cost * relative,
        half_spp=samples,
        half_error=row.errors.mean * measurement.spp / samples,
        fits=row.cost.pays(half_s),
    )


def best(candidates: Mapping[Candidate, CandidateAtCost]) -> CandidateAtCost:
    """The candidate with the least error × time, among those that were measured longest."""
    measured_longest = longest(list(candidates), lambda c: candidates[c].errors.images)
    return min((candidates[c] for c in measured_longest), key=lambda at_cost: at_cost.relative_cost)


def fitting(candidates: Mapping[Candidate, CandidateAtCost]) -> dict[Candidate, CandidateAtCost]:
    """Those of which a sample per pixel fits the cost."""
    return {c: at_cost for c, at_cost in candidates.items() if at_cost.fits}


def settle(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int]:
    """The settings to choose, given present ones: these, or others that are significantly better at the same cost.

    Rounding to a whole number of samples changes the cost a little, and at the new cost another candidate may be better
    still. So the search goes on until nothing is better, and a plan made for the result chooses it again. If the search
    comes back to earlier settings, the present ones stay.
    """
    seen = [(candidate, half_spp)]
    while (better := _better(measurement, *seen[-1])) is not None:
        if better in seen:
            return seen[0]
        seen.append(better)
    return seen[-1]


def _better(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int] | None:
    candidates = candidates_at_equal_cost(measurement, measurement.row(candidate).cost.time_s(half_spp))
    chosen = best(fitting(candidates))
    if chosen.candidate == candidate or not saving(chosen, over=candidates[candidate]).significant:
        return None
    return chosen.candidate, chosen.half_spp


# -------------------------------------------------------------------------------------------------- the plan


@dataclass(frozen=True, slots=True)
class TransportPlan:
    """The settings a spec should have, given the measurement and the cost that the spec accepts now."""

    spec: SceneSpec
    measurement: Measurement
    cached: bool
    candidate: Candidate  # connections and light ratio
    half_spp: int  # of about the cost of the spec's settings now
    photons: PhotonSpec
    photons_reason: str
    at_equal_cost: Mapping[Candidate, CandidateAtCost]  # all measured ones; empty if every view is black

    @property
    def settings(self) -> SpecTables:
        """The planned tables of the spec."""
        planned, now = self.candidate, self.spec.transport
        unusual: dict[str, Any] = {}  # settings that a spec need not state are written only where they matter
        if planned.guided_light or now.guided_light:
            unusual["guided_light"] = planned.guided_light
        if planned.light_samples > 1 or now.light_samples > 1:
            unusual["light_samples"] = planned.light_samples
        return {
            "transport": {
                "connections": planned.connections,
                "light_ratio": planned.light_ratio,
                "half_spp": self.half_spp,
                **unusual,
            },
            "photons": {"paths": self.photons.paths, "depth": self.photons.depth},
        }

    @property
    def changes(self) -> SpecTables:
        """The planned tables that differ from the spec's present ones."""
        now = {"transport": self.spec.transport.model_dump(), "photons": self.spec.photons.model_dump()}
        return {table: keys for table, keys in self.settings.items() if now[table] != now[table] | dict(keys)}

    def saving(self, over: Candidate) -> Saving:
        """The saving over other settings, which were measured."""
        return saving(self.at_equal_cost[self.candidate], self.at_equal_cost[over])

    @property
    def savings(self) -> tuple[Saving, ...]:
        """The savings over plain path tracing, the default and the spec's settings now, as far as these differ."""
        others = dict.fromkeys((PLAIN, DEFAULT, present(self.spec)))
        return tuple(self.saving(c) for c in others if c in self.at_equal_cost and c != self.candidate)

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "scene_id": self.spec.scene_id,
            "for": self.measurement.purpose.value,
            "settings": self.settings,
            "changes": self.changes,
            "savings": [{**asdict(s.over), "factor": s.factor, "spread": s.spread} for s in self.savings],
            "cached": self.cached,
            "measurement": self.measurement.model_dump(mode="json"),
        }


def make_plan(
    spec: SceneSpec, beside: Path | None, purpose: Purpose, *, seconds: float, again: bool, log: Log
) -> TransportPlan:
    """The plan of a spec for a purpose; a cached measurement is used if it took `seconds`, unless `again` is set."""
    kept = None if again else find(spec, purpose)
    if kept is not None and kept.asked_s >= seconds and _knows(kept, spec):
        return plan_of(spec, kept, cached=True)
    measurement = measure(spec, beside, purpose, seconds, log)
    try:
        keep(spec, measurement)
    except OSError as error:
        log(f"the measurement could not be kept: {error}")
    return plan_of(spec, measurement, cached=False)


def _knows(measurement: Measurement, spec: SceneSpec) -> bool:
    """Whether the spec's settings were measured, and at about their cost; if all is black, none need be."""
    if not measurement.rows:
        return True
    if not any(row.candidate == present(spec) for row in measurement.rows):
        return False
    half_s = measurement.row(present(spec)).cost.time_s(spec.transport.half_spp)
    return 1 / SIMILAR <= half_s / measurement.half_s <= SIMILAR


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> TransportPlan:
    """The plan that follows from a measurement for a spec as it is now; its settings are among those measured."""
    photons = recommend_photons(spec.photons, measurement.near, measurement.power, spec.transport.max_depth)
    now, half_spp = present(spec), spec.transport.half_spp
    if not measurement.rows:
        return TransportPlan(spec, measurement, cached, PLAIN, half_spp, *photons, {})
    at_equal_cost = candidates_at_equal_cost(measurement, measurement.row(now).cost.time_s(half_spp))
    return TransportPlan(spec, measurement, cached, *settle(measurement, now, half_spp), *photons, at_equal_cost)
