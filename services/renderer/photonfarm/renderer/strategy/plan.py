"""The plan of a spec's light transport, with reasons: `photonfarm scene plan`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonfarm.core.waiting import Log
from photonfarm.renderer.strategy.candidates import (
    PLAIN,
    AtEqualCost,
    Candidate,
    Saving,
    best,
    compare_at_cost,
    present,
    saving,
)
from photonfarm.renderer.strategy.content import recommend_photons
from photonfarm.renderer.strategy.measurement import Measurement, find, keep, measure
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.scene.spec import PhotonSpec, SceneSpec

SIMILAR = 4.0
"""The factor between times of half-estimates up to which a measurement still applies.

The choice depends on an image's fixed part, which matters if samples are few. A written plan keeps the time, up to a
sample.
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
    half_spp: int  # of about the cost of the spec's settings now
    photons: PhotonSpec
    photons_reason: str
    at_equal_cost: AtEqualCost  # all measured ones; empty if every view is black

    @property
    def settings(self) -> SpecTables:
        """The planned tables of the spec; settings that it need not state are written only where they matter."""
        planned, now = self.candidate, self.spec.transport
        transport = {"connections": planned.connections, "light_ratio": planned.light_ratio, "half_spp": self.half_spp}
        if planned.guided_light or now.guided_light:
            transport["guided_light"] = planned.guided_light
        if planned.light_samples > 1 or now.light_samples > 1:
            transport["light_samples"] = planned.light_samples
        return {"transport": transport, "photons": {"paths": self.photons.paths, "depth": self.photons.depth}}

    @property
    def changes(self) -> SpecTables:
        """The planned tables that differ from the spec's present ones."""
        now = {"transport": self.spec.transport.model_dump(), "photons": self.spec.photons.model_dump()}
        return {table: keys for table, keys in self.settings.items() if now[table] != now[table] | keys}

    @property
    def saving(self) -> Saving | None:
        """The saving over the spec's settings now; None if the plan keeps them, or nothing was measured."""
        now = present(self.spec)
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
    """The plan of a spec for a purpose; a cached measurement is used if it took `seconds`, unless `again` is set."""
    kept = None if again else find(spec, purpose)
    if kept is not None and kept.asked_s >= seconds and knows(kept, spec):
        return plan_of(spec, kept, cached=True)
    measurement = measure(spec, beside, purpose, seconds, log)
    try:
        keep(spec, measurement)
    except OSError as error:
        log(f"the measurement could not be kept: {error}")
    return plan_of(spec, measurement, cached=False)


def knows(measurement: Measurement, spec: SceneSpec) -> bool:
    """Whether the spec's settings were measured, and at about their cost; if all is black, none need be."""
    cost = measurement.costs.get(present(spec))
    if cost is None:
        return not measurement.rows
    return 1 / SIMILAR <= cost.time_s(spec.transport.half_spp) / measurement.half_s <= SIMILAR


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> TransportPlan:
    """The plan that follows from a measurement for a spec as it is now; its settings are among those measured.

    It has the present settings, or others that are significantly better at the same cost. Rounding to a whole number of
    samples changes the cost a little, and at the new cost another candidate may be better still. So the search goes on
    until nothing is better, and a plan made for the result chooses it again. If the search comes back to earlier
    settings, the present ones stay.
    """
    photons = recommend_photons(spec.photons, measurement.reach, spec.transport.max_depth)
    settings = present(spec), spec.transport.half_spp
    if not measurement.rows:
        return TransportPlan(spec, measurement, cached, PLAIN, spec.transport.half_spp, *photons, {})
    at_equal_cost, seen = _compare(measurement, *settings), [settings]
    while (better := _better(measurement, *seen[-1])) is not None:
        if better in seen:
            return TransportPlan(spec, measurement, cached, *seen[0], *photons, at_equal_cost)
        seen.append(better)
    return TransportPlan(spec, measurement, cached, *seen[-1], *photons, at_equal_cost)


def _compare(measurement: Measurement, candidate: Candidate, half_spp: int) -> AtEqualCost:
    """All candidates, at the cost of one with some samples per pixel."""
    return compare_at_cost(measurement.rows, measurement.spp, measurement.costs[candidate].time_s(half_spp))


def _better(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int] | None:
    candidates = _compare(measurement, candidate, half_spp)
    chosen = best(one for one in candidates.values() if one.fits)
    if chosen.candidate == candidate or not saving(chosen, over=candidates[candidate]).significant:
        return None
    return chosen.candidate, chosen.samples
