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


SECONDS = 60.0
"""CPU time of a pilot, unless another is asked for."""


@dataclass(frozen=True, slots=True)
class Saving:
    """How much sooner the settings of a plan reach the error of other settings."""

    over: Candidate
    factor: float  # time of the others over that of the plan's, to equal error
    spread: float | None  # its standard error

    def __str__(self) -> str:
        spread = "" if self.spread is None else f" ± {self.spread:.1g}"
        return f"the error of {self.over} in 1/{self.factor:.3g}{spread} of its time"


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
    """Whether the settings of the spec were measured, unless there was a reason not to."""
    return measurement.row(present(spec)) is not None or bool(measurement.left_out) or not measurement.rows


def plan_of(spec: SceneSpec, measurement: Measurement, *, cached: bool) -> Plan:
    """What follows from a measurement for a spec as it is now."""
    photons, reason = light_reach.recommend(spec.photons, measurement.near, measurement.power, spec.transport.max_depth)
    chosen, half_spp = _affordable(spec, measurement)
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


def _affordable(spec: SceneSpec, measurement: Measurement) -> tuple[Row | None, int]:
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


def lines(plan: Plan) -> list[str]:
    """The plan for people to read."""
    m = plan.measurement
    real = m.film == plan.spec.film and m.spp == plan.spec.transport.half_spp
    settings = f"{m.film.width} × {m.film.height} pixels, {m.spp} spp"
    if not real:
        settings += f" (the spec has {plan.spec.film.width} × {plan.spec.film.height}, {plan.spec.transport.half_spp})"
    origin = "kept from an earlier pilot; --again measures anew" if plan.cached else "measured now"
    return [
        f"{plan.spec.name}: {plan.candidate.connections} connections, light ratio {plan.candidate.light_ratio:g}, "
        f"half_spp {plan.half_spp}, photons {plan.photons.paths} × {plan.photons.depth}",
        "",
        "Modelled",
        *(f"  {sentence}" for sentence in m.modelled),
        f"  {plan.photons_reason}",
        f"  both half-estimates: they cost {plan.halves_overhead:.0%} more than one image of twice the samples, and "
        "without them no error could be measured free of noise",
        "Left out",
        *(f"  {sentence}" for sentence in (*m.left_out, *_unchosen(plan)) or ("nothing",)),
        "Why",
        *(f"  {reason}" for reason in (*m.reasons, *_too_costly(plan))),
        *(f"  it reaches {saving}" for saving in plan.savings),
        "",
        *_table(plan),
        "",
        f"{origin}: {m.views} views, {settings}; {m.spent_s:.0f} s of CPU, {m.compiling_s:.0f} of them not measuring",
    ]


def _unchosen(plan: Plan) -> list[str]:
    if plan.measurement.left_out or not plan.measurement.rows:
        return []
    if not plan.candidate.light_ratio:
        return ["light paths: no ratio of them pays here"]
    if not plan.candidate.connections:
        return ["connections: light paths that are joined to the camera alone reach the same error sooner"]
    return []


def _too_costly(plan: Plan) -> list[str]:
    best = plan.measurement.candidate
    if plan.candidate == best or not plan.measurement.rows:
        return []
    return [
        f"but one sample of {best} costs more than a half-estimate does now, so {plan.candidate} is taken; "
        f"{best} will be with a larger half_spp"
    ]


def _table(plan: Plan) -> list[str]:
    m = plan.measurement
    head = f"{'connections':>11} {'light ratio':>11} {'images':>6} {'relMSE':>9} {'ms':>8} {'error × time':>16}"
    return [head] + [
        f"{row.connections:>11} {row.light_ratio:>11g} {row.images:>6} {row.error:>9.3g} "
        f"{1e3 * row.time_s(m.spp):>8.1f} {row.relative_cost:>8.3g} ± {row.spread or 0:<5.1g}"
        + ("  chosen" if row.candidate == plan.candidate else "")
        for row in m.rows
    ]
