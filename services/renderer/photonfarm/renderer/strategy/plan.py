"""The plan of a spec's light transport, with reasons: `photonfarm scene plan`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from photonfarm.renderer.strategy import cache, light_reach
from photonfarm.renderer.strategy.candidate import DEFAULT, PLAIN, Candidate
from photonfarm.renderer.strategy.choices import CandidateAtCost, candidates_at_equal_cost, settled
from photonfarm.renderer.strategy.comparison import Saving, saving
from photonfarm.renderer.strategy.measurement import Measurement, measure, present
from photonfarm.renderer.strategy.objective.purpose import Purpose
from photonfarm.renderer.strategy.output.spec_file import SpecTables
from photonfarm.shared.core.waiting import Log
from photonfarm.shared.scene.spec import PhotonSpec, SceneSpec

SIMILAR = 4.0
"""The factor between times of half-estimates up to which a measurement still applies.

The choice depends on an image's fixed part, which matters if samples are few. A written plan keeps the time, up to a
sample.
"""


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
    halves_overhead: float | None  # share of time that two half-estimates add to one image of twice the samples; None
    # if they were taken to share a launch, as for training

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
                "connections": self.candidate.connections,
                "light_ratio": self.candidate.light_ratio,
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
            "savings": [
                {**asdict(s.over), "factor": s.factor, "spread": s.spread}
                for s in self.savings
            ],
            "halves_overhead": self.halves_overhead,
            "cached": self.cached,
            "measurement": self.measurement.model_dump(mode="json"),
        }  # fmt: skip


def make_plan(
    spec: SceneSpec, beside: Path | None, purpose: Purpose, *, seconds: float, again: bool, log: Log
) -> TransportPlan:
    """The plan of a spec for a purpose; a cached measurement is used if it took `seconds`, unless `again` is set."""
    found = None if again else cache.find(spec, purpose)
    if found is not None and found.asked_s >= seconds and _knows(found, spec):
        return plan_of(spec, found, cached=True)
    measurement = measure(spec, beside, purpose, seconds, log)
    try:
        cache.keep(spec, measurement)
    except OSError as error:
        log(f"the measurement could not be kept: {error}")
    return plan_of(spec, measurement, cached=False)


def _knows(measurement: Measurement, spec: SceneSpec) -> bool:
    """Whether the spec's settings were measured, and at about their cost; if all is black, none need be."""
    if not measurement.rows:
        return True
    now = present(spec)
    if not measurement.knows(now):
        return False
    half_s = measurement.row(now).cost.time_s(spec.transport.half_spp)
    return 1 / SIMILAR <= half_s / measurement.half_s <= SIMILAR


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> TransportPlan:
    """The plan that follows from a measurement for a spec as it is now; its settings are among those measured."""
    photons, reason = light_reach.recommend(spec.photons, measurement.near, measurement.power, spec.transport.max_depth)
    half_spp = spec.transport.half_spp
    if not measurement.rows:
        return TransportPlan(spec, measurement, cached, PLAIN, half_spp, photons, reason, {}, None)
    now = present(spec)
    candidate, samples = settled(measurement, now, half_spp)
    cost, shared = measurement.row(candidate).cost, measurement.purpose is Purpose.TRAINING
    return TransportPlan(
        spec=spec,
        measurement=measurement,
        cached=cached,
        candidate=candidate,
        half_spp=samples,
        photons=photons,
        photons_reason=reason,
        at_equal_cost=candidates_at_equal_cost(measurement, measurement.row(now).cost.time_s(half_spp)),
        halves_overhead=None if shared else 2 * cost.time_s(samples) / cost.time_s(2 * samples) - 1,
    )
