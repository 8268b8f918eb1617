"""One scene measured: every method at equal time, in turns, against a reference of its own."""

from __future__ import annotations

import gc
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.renderer.peers import chosen, luxcore, luxcore_scene, scoring
from bench.renderer.peers.errors import ReferenceImage, reference_of
from bench.renderer.peers.methods import Calibration, Method, MitsubaMethod, Shot, calibrate, integrator, multijittered
from bench.renderer.peers.plans import BUDGETS, ScenePlan

REFERENCE_IMAGES = 8
REFERENCE_SEED = 1_000_000


@dataclass(frozen=True, slots=True)
class MeasureSettings:
    """How to measure; a result is valid for exactly these."""

    methods: tuple[str, ...]
    seconds: float  # time budget of an image, on `clock`
    seeds: int  # K, independent images of each method at each budget
    size: int  # pixels, square
    threads: int
    clock: str  # 'wall' or 'cpu'
    reference: float  # time of each reference, in budgets
    pilot_seconds: float  # CPU time of the pilot
    chosen: str  # settings given instead of a pilot, "CONNECTIONS,LIGHT_RATIO[,guided]", or ""

    @property
    def budgets_s(self) -> tuple[float, ...]:
        """Seconds of the images rendered, shortest first."""
        return tuple(share * self.seconds for share in BUDGETS)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMethod:
    """The images of one method."""

    calibration: Calibration
    shots: list[list[Shot]]  # [budget][round]


@dataclass(frozen=True, slots=True, eq=False)
class SceneToMeasure:
    """One scene to measure: what every step needs to know."""

    plan: ScenePlan
    settings: MeasureSettings
    scene: Any  # Mitsuba's, loaded

    def method(self, name: str, chosen: dict[str, Any] | None = None) -> MitsubaMethod:
        """One of Mitsuba's methods on this scene; `chosen` holds the parameters of the method 'chosen'."""
        camera = multijittered(self.scene) if name == "path-multijitter" else None
        return MitsubaMethod(self.scene, integrator(name, self.plan.max_depth, chosen or {}), camera)


def measure(name: str, plan: ScenePlan, settings: MeasureSettings, scene: Any) -> dict[str, Any]:
    """The result of one line, as JSON takes it."""
    line = SceneToMeasure(plan, settings, scene)
    methods, absent, differences = _peers(line)
    try:
        calibrations = {name: _calibrated(name, methods[name], settings) for name in methods}
        settled = _settle(line, calibrations)
        if settled is not None:
            methods["chosen"] = line.method("chosen", settled.parameters())
            calibrations["chosen"] = _calibrated("chosen", methods["chosen"], settings)
        measured = _in_turns(methods, calibrations, settings)
        references, described = _references(line, methods, calibrations)
    finally:
        for method in methods.values():
            method.close()
    rows = scoring.rows(measured, references, settings.clock)
    return {
        "line": name,
        "scene": plan.scene,
        "max_depth": plan.max_depth,
        "note": plan.note,
        "reference": described,
        "chosen": None
        if settled is None
        else {**settled.parameters(), "pilot_wall_s": settled.pilot_wall_s, "why": settled.why},
        "absent": absent,
        "differences": sorted(differences),
        "rows": rows,
        "gains": scoring.gains("chosen", measured, references, settings.clock),
        "curves": scoring.curves(measured, references, settings.clock),
    }


def say(line: str) -> None:
    """Talk goes to standard error, results to standard output."""
    print(line, file=sys.stderr, flush=True)


def _calibrated(name: str, method: Method, settings: MeasureSettings) -> Calibration:
    found = calibrate(method, settings.budgets_s, settings.clock)
    say(f"  {name}: {found.spp} spp, compiled in {found.compile_s:.1f} s")
    return found


def _settle(line: SceneToMeasure, calibrations: Mapping[str, Calibration]) -> chosen.Chosen | None:
    """The settings of the method 'chosen'. After the others are compiled: the pilot compiles all of its candidates."""
    settings = line.settings
    if "chosen" not in settings.methods:
        return None
    if settings.chosen:
        return chosen.given(settings.chosen)
    known = calibrations.get("bdpt") or calibrate(line.method("bdpt"), settings.budgets_s, settings.clock)
    found = chosen.by_pilot(line.scene, line.plan.max_depth, settings.pilot_seconds, chosen.pilot_spp(known))
    say(f"  pilot: connections {found.connections}, light_ratio {found.light_ratio:g} in {found.pilot_wall_s:.0f} s")
    return found


def _peers(line: SceneToMeasure) -> tuple[dict[str, Method], dict[str, str], set[str]]:
    """(methods but 'chosen' by name, why others are absent, in what LuxCore's scene is only almost the same)."""
    methods: dict[str, Method] = {}
    absent: dict[str, str] = {}
    differences: set[str] = set()
    for name in line.settings.methods:
        if name == "chosen":
            continue
        if name != "pyluxcore":
            methods[name] = line.method(name)
            continue
        try:
            translated = luxcore_scene.translate(line.scene)
        except luxcore_scene.NotExpressibleError as reason:
            absent[name] = f"not expressible: {reason}"
            continue
        if not luxcore.installed():
            absent[name] = "pyluxcore is not installed"
            continue
        differences = translated.differences
        methods[name] = luxcore.LuxCoreMethod(
            translated, size=line.settings.size, max_depth=line.plan.max_depth, threads=line.settings.threads
        )
    return methods, absent, differences


def _in_turns(
    methods: Mapping[str, Method], calibrations: Mapping[str, Calibration], settings: MeasureSettings
) -> dict[str, MeasuredMethod]:
    """Every round renders one image of every method at every budget, so that drift of the machine meets all alike."""
    measured = {name: MeasuredMethod(calibrations[name], [[] for _ in BUDGETS]) for name in methods}
    for k in range(settings.seeds):
        order = list(methods)[k % len(methods) :] + list(methods)[: k % len(methods)]
        for name in order:
            for b, spp in enumerate(calibrations[name].spp):
                measured[name].shots[b].append(methods[name].render(100 + 1000 * b + k, spp))
        gc.collect()
    return measured


def _references(
    line: SceneToMeasure, methods: Mapping[str, Method], calibrations: Mapping[str, Calibration]
) -> tuple[dict[str, ReferenceImage], str]:
    """(reference of each method, what the common one is made of).

    LuxCore has its own, as its scene differs a little.
    """
    settings = line.settings
    share = settings.reference / REFERENCE_IMAGES
    sets, described = [], []
    for name in line.plan.reference:
        method = line.method(name)
        known = calibrations.get(name) or calibrate(method, (settings.seconds,), settings.clock)
        spp = max(1, round(known.spp[-1] * share))
        sets.append(_images(method, spp))
        described.append(f"{name} {REFERENCE_IMAGES} × {spp} spp")
    common = reference_of(sets)
    references = dict.fromkeys(methods, common)
    if "pyluxcore" in methods:
        spp = max(1, round(calibrations["pyluxcore"].spp[-1] * share))
        references["pyluxcore"] = reference_of([_images(methods["pyluxcore"], spp)])
    return references | {"common": common}, " and ".join(described)


def _images(method: Method, spp: int) -> Any:
    seeds: Sequence[int] = range(REFERENCE_SEED, REFERENCE_SEED + REFERENCE_IMAGES)
    return np.stack([method.render(seed, spp).image for seed in seeds])
