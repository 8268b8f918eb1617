"""What a spec should say about light transport, and why: `photonfarm scene plan`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.renderer.strategy import cache, light_reach
from photonfarm.renderer.strategy.measurement import DEFAULT, Measurement, Row, Talk, measure, present
from photonfarm.renderer.strategy.pilot import PLAIN, Candidate
from photonfarm.shared.scene import PhotonSpec, SceneSpec

LEAST_SAMPLES = 0.7
"""Samples per pixel that the present cost must pay for: rounded up to 1, they cost at most 1.4 times as much."""


SIMILAR_SPP = 4.0
"""Times as many samples per pixel, or as few, to which a measurement is taken to apply: what an image costs whatever
its samples are weighs on the choice where they are few."""

SECONDS = 60.0
"""CPU time of a pilot, unless another is asked for."""


@dataclass(frozen=True, slots=True)
class Saving:
    """How much sooner the settings of a plan reach the error of other settings."""

    over: Candidate
    factor: float  # time of the others over that of the plan's, to equal error
    spread: float | None  # its standard error


@dataclass(frozen=True, slots=True)
class Plan:
    """The settings a spec should have, from what was measured and the cost it accepts now."""

    spec: SceneSpec
    measurement: Measurement
    cached: bool
    candidate: Candidate  # connections and light ratio
    half_spp: int  # of equal cost per sample as the spec's settings now
    photons: PhotonSpec
    photons_reason: str
    savings: tuple[Saving, ...]
    halves_overhead: float  # two half-estimates against one image of twice the samples: share of time added

    @property
    def settings(self) -> Mapping[str, Mapping[str, int | float]]:
        """The tables of a spec and what they should say."""
        return {
            "transport": {
                "connections": self.candidate.connections,
                "light_ratio": self.candidate.light_ratio,
                "half_spp": self.half_spp,
            },
            "photons": {"paths": self.photons.paths, "depth": self.photons.depth},
        }

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "scene_id": self.spec.scene_id,
            "settings": self.settings,
            "savings": [
                {"connections": s.over.connections, "light_ratio": s.over.light_ratio, "factor": s.factor,
                 "spread": s.spread}
                for s in self.savings
            ],
            "halves_overhead": self.halves_overhead,
            "cached": self.cached,
            "measurement": self.measurement.model_dump(mode="json"),
        }  # fmt: skip


def make_plan(spec: SceneSpec, beside: Path | None, *, seconds: float | None, again: bool, talk: Talk) -> Plan:
    """The plan of a spec: from the cache, if it is there, took no less than `seconds`, and is not wanted again."""
    found = None if again else cache.find(spec)
    if found is not None and found.asked_s >= (seconds or 0) and _knows(found, spec):
        return plan_of(spec, found, cached=True)
    measurement = measure(spec, beside, seconds or SECONDS, talk)
    try:
        cache.keep(spec, measurement)
    except OSError as error:
        talk(f"the measurement could not be kept: {error}")
    return plan_of(spec, measurement, cached=False)


def _knows(measurement: Measurement, spec: SceneSpec) -> bool:
    """Whether the settings of the spec were measured, unless there was a reason not to, and about its samples."""
    if not 1 / SIMILAR_SPP <= spec.transport.half_spp / measurement.half_spp <= SIMILAR_SPP:
        return False
    return measurement.row(present(spec)) is not None or bool(measurement.left_out) or not measurement.rows


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> Plan:
    """What follows from a measurement for a spec as it is now."""
    photons, reason = light_reach.recommend(spec.photons, measurement.near, measurement.power, spec.transport.max_depth)
    chosen, half_spp = _best_at_cost(spec, measurement)
    if chosen is None:
        return Plan(spec, measurement, cached, PLAIN, half_spp, photons, reason, (), 0.0)
    others = dict.fromkeys(c for c in (PLAIN, DEFAULT, present(spec)) if c != chosen.candidate)
    return Plan(
        spec=spec,
        measurement=measurement,
        cached=cached,
        candidate=chosen.candidate,
        half_spp=half_spp,
        photons=photons,
        photons_reason=reason,
        savings=tuple(_saving(row, chosen) for row in map(measurement.row, others) if row is not None),
        halves_overhead=2 * chosen.time_s(half_spp) / chosen.time_s(2 * half_spp) - 1,
    )


def _best_at_cost(spec: SceneSpec, measurement: Measurement) -> tuple[Row | None, int]:
    """The best candidate that has a sample at least for what a half costs now, and the samples per pixel it has then.

    They are those of the spec where its present settings were not measured, or no candidate was.
    """
    now, samples = measurement.row(present(spec)), spec.transport.half_spp
    ranked = sorted(measurement.rows, key=lambda row: (row.candidate != measurement.candidate, row.relative_cost))
    for row in ranked if now else ranked[:1]:
        if now is None or row.candidate == now.candidate:
            return row, samples
        affordable = (now.time_s(samples) - row.fixed_s) / row.sample_s
        if affordable >= LEAST_SAMPLES:
            return row, int(np.clip(round(affordable), 1, 65536))
    return None, samples


def _saving(row: Row, chosen: Row) -> Saving:
    """The spreads of both are taken as independent, which overstates that of their ratio."""
    factor = row.relative_cost / chosen.relative_cost
    if row.spread is None or chosen.spread is None:
        return Saving(row.candidate, factor, None)
    relative = np.hypot(row.spread / row.relative_cost, chosen.spread / chosen.relative_cost)
    return Saving(row.candidate, factor, float(factor * relative))
