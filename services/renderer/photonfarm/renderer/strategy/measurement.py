"""What was measured of a spec's scene: everything a plan follows from, as it is kept on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photonfarm.renderer.strategy import content, light_reach, pilot
from photonfarm.renderer.strategy.pilot import Candidate, Render
from photonfarm.renderer.strategy.stage import SEED, Stage
from photonfarm.shared.scene import Film, Frozen, SceneSpec

DEFAULT = Candidate(1, 1.0)
"""The settings of a spec that names none."""

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

LEAST_VIEWS, MOST_VIEWS = 3, 8

Talk = Callable[[str], None]
"""Takes a line on what is going on."""


class Row(Frozen):
    """One candidate: as `pilot.Measured`, and what its time is made of."""

    connections: int
    light_ratio: float
    images: int
    error: float
    missed: float
    relative_cost: float
    spread: float | None
    fixed_s: float  # as of `ImageCost`, on the spec's film
    sample_s: float

    @property
    def candidate(self) -> Candidate:
        """The settings."""
        return Candidate(self.connections, self.light_ratio)

    def time_s(self, spp: float) -> float:
        """CPU time of an image of the spec's film."""
        return self.fixed_s + spp * self.sample_s


class Measurement(Frozen):
    """One pilot of one scene; it does not depend on the settings that a plan changes."""

    film: Film  # of the pilot
    spp: int
    half_spp: int  # of the spec when it was measured: what the time in `relative_cost` is that of
    views: int
    max_depth: int
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[Row, ...]  # without any where every view is black
    chosen: tuple[int, float]  # connections, light ratio
    reasons: tuple[str, ...]
    filled: tuple[float, ...]  # of light_reach
    near: tuple[float, ...]
    power: tuple[float, ...]
    asked_s: float  # CPU time that the pilot was given
    spent_s: float  # CPU time of everything
    compiling_s: float  # of it: loading, kernels, and what the images are weighted with

    @property
    def candidate(self) -> Candidate:
        """The settings to render with."""
        return Candidate(*self.chosen)

    def row(self, candidate: Candidate) -> Row | None:
        """What was measured of a candidate, if it was."""
        return next((row for row in self.rows if row.candidate == candidate), None)


@dataclass(frozen=True, slots=True)
class ImageCost:
    """CPU time of an image: what it takes whatever its samples are, and what each sample per pixel adds."""

    fixed_s: float
    sample_s: float

    @classmethod
    def of(cls, render: Render, candidate: Candidate, clock: Callable[[], float]) -> ImageCost:
        """From images of 1 and of 5 samples per pixel; of two the faster, as what disturbs never makes faster."""
        render(candidate, 0, 1)  # compiles
        one, five = (min(_time_of(render, candidate, spp, clock) for _ in range(2)) for spp in (1, 5))
        sample_s = max((five - one) / 4, 0.02 * one)  # a small film may drown in the noise of its fixed part
        return cls(max(one - sample_s, 0.0), sample_s)

    def time_s(self, spp: float) -> float:
        """Of an image with so many samples per pixel."""
        return self.fixed_s + spp * self.sample_s


def _time_of(render: Render, candidate: Candidate, spp: int, clock: Callable[[], float]) -> float:
    start = clock()
    render(candidate, 1, spp)
    return clock() - start


def measure(spec: SceneSpec, beside: Path | None, seconds: float, talk: Talk) -> Measurement:
    """Load the scene of a spec and measure what its light transport needs, in about `seconds` of CPU time.

    Raises SpecError and BackendError as loading does.
    """
    begun = time.process_time()
    talk(f"loading {spec.name}")
    stage = Stage(spec, beside)
    found = content.read(stage.loaded.scene, stage.camera())
    reach = light_reach.measure(stage.configurations(LEAST_VIEWS), spec.view, SEED)
    depth = spec.transport.max_depth
    candidates, left_out = content.restrict(found, depth, reach.hit, dict.fromkeys([*GRID, present(spec)]))
    costs = {candidate: ImageCost.of(stage.renders(1)[0], candidate, stage.clock) for candidate in candidates}
    film, spp, views = _pilot_film(spec, list(costs.values()), seconds)
    if film != spec.film:
        stage = Stage(spec.model_copy(update={"film": film}), beside)
    talk(f"measuring {len(candidates)} settings in {views} views of {film.width} × {film.height}, {spp} spp")
    pilot_spp = spp * film.width * film.height / (spec.film.width * spec.film.height)  # of the spec's film
    half_spp = spec.transport.half_spp
    choice = pilot.choose(
        stage.renders(views),
        candidates,
        seconds=seconds,
        spp=spp,
        seed=SEED,
        keep=[c for c in (DEFAULT, present(spec)) if c in candidates],
        later={candidate: cost.time_s(half_spp) / cost.time_s(pilot_spp) for candidate, cost in costs.items()},
        clock=stage.clock,
    )
    rows = [_row(measured, costs[measured.candidate], pilot_spp) for measured in choice.measured]
    spent = time.process_time() - begun
    return Measurement(
        film=film,
        spp=spp,
        half_spp=half_spp,
        views=choice.views,
        max_depth=depth,
        modelled=tuple(content.sentences(found, depth)),
        left_out=tuple(map(str, left_out)),
        rows=tuple(rows),
        chosen=(choice.candidate.connections, choice.candidate.light_ratio),
        reasons=choice.reasons,
        filled=reach.filled,
        near=reach.near,
        power=reach.power,
        asked_s=seconds,
        spent_s=spent,
        compiling_s=spent - choice.spent_s + choice.scouting_s,
    )


def present(spec: SceneSpec) -> Candidate:
    """The settings that a spec has."""
    return Candidate(spec.transport.connections, spec.transport.light_ratio)


def _pilot_film(spec: SceneSpec, costs: Sequence[ImageCost], seconds: float) -> tuple[Film, int, int]:
    """Film, samples per pixel and number of views whose first round takes no more than its share of the time.

    Wanted are those of the spec, and as many views as there is time for. Samples are given up first; then the film is
    halved, as long as the samples are what takes the time.
    """
    fixed, sample = sum(cost.fixed_s for cost in costs), sum(cost.sample_s for cost in costs)
    images = 2 + max(1.0, pilot.SCOUTS / len(costs))
    budget = FIRST_ROUND * seconds / images  # for one image of each candidate in each view
    spp = int(np.clip((budget / LEAST_VIEWS - fixed) / sample, 1, spec.transport.half_spp))
    film = spec.film
    while LEAST_VIEWS * (fixed + spp * sample) > budget and spp * sample > fixed and min(film.width, film.height) >= 64:
        film = Film(width=film.width // 16 * 8, height=film.height // 16 * 8)
        sample /= 4
    return film, spp, int(np.clip(budget / (fixed + spp * sample), LEAST_VIEWS, MOST_VIEWS))


def _row(measured: pilot.Measured, cost: ImageCost, pilot_spp: float) -> Row:
    """The cost that was found beforehand, corrected by the many images of the pilot."""
    correction = measured.time_s / cost.time_s(pilot_spp)
    return Row(
        connections=measured.candidate.connections,
        light_ratio=measured.candidate.light_ratio,
        images=measured.images,
        error=measured.error,
        missed=measured.missed,
        relative_cost=measured.relative_cost,
        spread=measured.spread,
        fixed_s=correction * cost.fixed_s,
        sample_s=correction * cost.sample_s,
    )
