"""What was measured of a spec's scene: everything a plan follows from, as it is kept on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photonfarm.renderer.strategy import content, light_reach, pilot
from photonfarm.renderer.strategy.candidate import DEFAULT, Candidate
from photonfarm.renderer.strategy.comparison import Errors, Measured
from photonfarm.renderer.strategy.image_cost import RANGE, ImageCost, time_images
from photonfarm.renderer.strategy.pilot_scene import SEED, Stage
from photonfarm.renderer.strategy.rounds import SCOUTS
from photonfarm.shared.scene.spec import Film, Frozen, SceneSpec

GRID = tuple(
    Candidate(c, r)
    for c, r in ((0, 0.0), (0, 0.25), (0, 1.0), (0, 4.0), (0, 16.0), (1, 0.25), (1, 1.0), (2, 1.0), (4, 1.0), (8, 1.0))
)
"""The candidates of every pilot; those that a scene's content makes pointless are left out.

More light paths than eye paths are for light that only they find, in splats: connections use as many of them as there
are eye vertices, so that a ratio above 1 would buy connections nothing.
"""

FIRST_ROUND = 0.4
"""Share of the pilot's time for its first round, at most: what follows decides between the best."""

TIMING = 0.2
"""Share of the time for how long images take."""

LEAST_VIEWS, MOST_VIEWS = 3, 8

LIT = 16
"""Configurations in which light paths are traced: photons that shine in any of them are worth storing."""

Talk = Callable[[str], None]
"""Takes a line on what is going on."""


class Row(Frozen):
    """One candidate: what `Measured` rests on, and what its time is made of."""

    connections: int
    light_ratio: float
    errors: Errors  # of images of `Measurement.spp`
    missed: float  # as of `Measured`
    fixed_s: float  # as of `ImageCost`, on the spec's film
    sample_s: float

    @property
    def candidate(self) -> Candidate:
        """The settings."""
        return Candidate(self.connections, self.light_ratio)

    @property
    def cost(self) -> ImageCost:
        """CPU time of an image of the spec's film."""
        return ImageCost(self.fixed_s, self.sample_s)


class Measurement(Frozen):
    """One pilot of one scene. All that a plan rests on, whatever settings of those that it decides a spec has."""

    film: Film  # of the pilot
    spp: int
    half_s: float  # CPU time of a half-estimate that the spec had accepted: what the pilot compared at
    views: int
    max_depth: int
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[Row, ...]  # without any where every view is black
    shared: float  # as of `Choice`
    filled: tuple[float, ...]  # of light_reach
    near: tuple[tuple[float, ...], ...]
    power: tuple[tuple[float, ...], ...]
    asked_s: float  # CPU time that the pilot was given
    spent_s: float  # CPU time of everything
    compiling_s: float  # of it: loading, kernels, and what the images are weighted with

    def knows(self, candidate: Candidate) -> bool:
        """Whether it was measured."""
        return any(row.candidate == candidate for row in self.rows)

    def row(self, candidate: Candidate) -> Row:
        """What was measured of a candidate."""
        return next(row for row in self.rows if row.candidate == candidate)


@dataclass(frozen=True, slots=True)
class _Compared:
    """The candidates' images: of which film and how many samples per pixel, and what the pilot found in them."""

    film: Film
    spp: int
    half_s: float
    choice: pilot.Choice
    rows: tuple[Row, ...]


def measure(spec: SceneSpec, beside: Path | None, seconds: float, talk: Talk) -> Measurement:
    """Load the scene of a spec and measure what its light transport needs, in about `seconds` of CPU time.

    The spec's settings are measured in any case. Raises SpecError and BackendError as loading does.
    """
    begun = time.process_time()
    talk(f"loading {spec.name}")
    stage = Stage(spec, beside)
    found = content.read(stage.loaded.scene, stage.camera())
    reach = light_reach.measure(stage.configurations(LIT), spec.view, SEED)
    depth = spec.transport.max_depth
    candidates, left_out = content.restrict(found, depth, reach.hit, GRID)
    compared = _compare(stage, beside, list(dict.fromkeys([*candidates, present(spec)])), seconds, talk)
    spent = time.process_time() - begun
    return Measurement(
        film=compared.film,
        spp=compared.spp,
        half_s=compared.half_s,
        views=compared.choice.views,
        max_depth=depth,
        modelled=tuple(content.sentences(found, depth)),
        left_out=tuple(map(str, left_out)),
        rows=compared.rows,
        shared=compared.choice.shared,
        filled=reach.filled,
        near=reach.near,
        power=reach.power,
        asked_s=seconds,
        spent_s=spent,
        compiling_s=spent - compared.choice.spent_s + compared.choice.scouting_s,
    )


def _compare(stage: Stage, beside: Path | None, candidates: list[Candidate], seconds: float, talk: Talk) -> _Compared:
    spec = stage.spec
    now, half_spp, left_s = present(spec), spec.transport.half_spp, (1 - TIMING) * seconds
    costs = time_images(stage.renders(1)[0], candidates, half_spp, TIMING * seconds, stage.clock)
    half_s = costs[now].time_s(half_spp)
    film, spp, views = _pilot_film(spec, costs, left_s)
    if film != spec.film:
        stage = Stage(spec.model_copy(update={"film": film}), beside)
    talk(f"measuring {len(candidates)} settings in {views} views of {film.width} × {film.height}, {spp} spp")
    pilot_spp = spp * film.width * film.height / (spec.film.width * spec.film.height)  # of the spec's film
    choice = pilot.choose(
        stage.renders(views),
        candidates,
        seconds=left_s,
        spp=spp,
        seed=SEED,
        keep=[c for c in (DEFAULT, now) if c in candidates],
        later={candidate: _images(cost, half_s, spp) / cost.time_s(pilot_spp) for candidate, cost in costs.items()},
        clock=stage.clock,
    )
    rows = tuple(_row(measured, costs[measured.candidate], pilot_spp, half_spp) for measured in choice.measured)
    return _Compared(film, spp, half_s, choice, rows)


def present(spec: SceneSpec) -> Candidate:
    """The settings that a spec has."""
    return Candidate(spec.transport.connections, spec.transport.light_ratio)


def _images(cost: ImageCost, half_s: float, spp: int) -> float:
    """CPU time until half-estimates that take `half_s` have the error of an image of `spp` samples per pixel."""
    samples = cost.bought(half_s)
    return spp / samples * cost.time_s(samples)


def _pilot_film(spec: SceneSpec, costs: Mapping[Candidate, ImageCost], seconds: float) -> tuple[Film, int, int]:
    """Film, samples per pixel and number of views whose first round takes no more than its share of the time.

    Wanted are those of the spec, and as many views as there is time for. Samples are given up first; then the film is
    halved, as long as the samples are what takes the time.
    """
    fixed, sample = sum(cost.fixed_s for cost in costs.values()), sum(cost.sample_s for cost in costs.values())
    images = 2 + max(1.0, SCOUTS / len(costs))
    budget = FIRST_ROUND * seconds / images  # for one image of each candidate in each view
    spp = int(np.clip((budget / LEAST_VIEWS - fixed) / sample, 1, spec.transport.half_spp))
    film = spec.film
    while LEAST_VIEWS * (fixed + spp * sample) > budget and spp * sample > fixed and min(film.width, film.height) >= 64:
        film = Film(width=film.width // 16 * 8, height=film.height // 16 * 8)
        sample /= 4
    return film, spp, int(np.clip(budget / (fixed + spp * sample), LEAST_VIEWS, MOST_VIEWS))


def _row(measured: Measured, cost: ImageCost, pilot_spp: float, half_spp: int) -> Row:
    """The cost that was found beforehand, corrected by the many images of the pilot.

    Unless these are of far fewer samples: then what they take beside their samples says little of the samples' time.
    """
    similar = RANGE * pilot_spp >= half_spp
    correction = measured.time_s / cost.time_s(pilot_spp) if similar else 1.0
    return Row(
        connections=measured.candidate.connections,
        light_ratio=measured.candidate.light_ratio,
        errors=measured.errors,
        missed=measured.missed,
        fixed_s=correction * cost.fixed_s,
        sample_s=correction * cost.sample_s,
    )
