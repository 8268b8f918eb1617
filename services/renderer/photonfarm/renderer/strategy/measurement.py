"""The measurement of a spec's scene: everything that a plan depends on, as it is kept on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photonfarm.renderer.strategy import content, light_reach, pilot
from photonfarm.renderer.strategy.budget import EDITS, LEAST_VIEWS, Budget, affordable
from photonfarm.renderer.strategy.candidate import DEFAULT, PLAIN, Candidate
from photonfarm.renderer.strategy.comparison import MeasuredCandidate, RelativeErrors
from photonfarm.renderer.strategy.image_cost import RANGE, ImageCost, time_images
from photonfarm.renderer.strategy.objective import view_cost
from photonfarm.renderer.strategy.objective.purpose import Purpose
from photonfarm.renderer.strategy.objective.view_cost import FREE, ViewCost
from photonfarm.renderer.strategy.pilot_scene import SEED, PilotScene
from photonfarm.renderer.strategy.rounds import SCOUTS
from photonfarm.shared.core.models import Frozen
from photonfarm.shared.core.waiting import Log, WorkLog
from photonfarm.shared.scene.spec import Film, SceneSpec

GRID = (
    PLAIN,
    Candidate(4, 0.125, True),
    Candidate(2, 0.25, light_samples=4),
    Candidate(0, 1.0, True),
    Candidate(8, 0.0625, True),
    Candidate(4, 0.125, light_samples=2),
    Candidate(2, 0.25),
    Candidate(2, 0.25, True, light_samples=2),
    Candidate(0, 16.0, True),
    Candidate(4, 0.125),
    Candidate(2, 0.25, light_samples=2),
    Candidate(2, 0.25, True),
    Candidate(1, 1.0),
    *(Candidate(0, ratio) for ratio in (0.25, 1.0, 4.0, 16.0)),
)
"""The candidates of every pilot, except those that a scene's content makes pointless.

Where there is no time for all, only the first are compared. So the most useful come first: guided light paths with
connections for indirect light, several light samples for evenly lit rooms, guided splats alone for caustics.

A light ratio above 1 helps only with light that splats alone find. Connections need few light paths, as several eye
paths may be joined to the same one. Several light samples pay where direct light at the first eye vertex has much of
the noise, as in evenly lit rooms.
"""

FIRST_ROUND = 0.4
"""The largest share of the pilot's time for its first round: later rounds decide between the best."""

TIMING = 0.2
"""The share of the given time that is spent on timing images."""

MOST_VIEWS = 8

LIT, LEAST_LIT, REACH = 16, 2, 0.25
"""The number of configurations in which light paths are traced, to see which photons are worth storing: 16, or as many,
at least 2, as a quarter of the time allows, with what went before."""

BESIDE = 0.35
"""The share of the time after which no more views are looked at beside their images, for training."""

IMAGES = 400
"""The number of images that the time should pay for: about as many as ten settings need at least."""


class CandidateRow(Frozen):
    """One candidate: the values of `MeasuredCandidate`, and the two parts of its time."""

    connections: int
    light_ratio: float
    guided_light: bool = False
    light_samples: int = 1
    errors: RelativeErrors  # of images of `Measurement.spp`
    missed: float  # as in `MeasuredCandidate`
    fixed_s: float  # as in `ImageCost`, of a half-estimate on the spec's film
    sample_s: float

    @property
    def candidate(self) -> Candidate:
        """The settings."""
        return Candidate(self.connections, self.light_ratio, self.guided_light, self.light_samples)

    @property
    def cost(self) -> ImageCost:
        """The CPU time of a half-estimate."""
        return ImageCost(self.fixed_s, self.sample_s)


class Measurement(Frozen):
    """One pilot of one scene: all that a plan depends on besides the settings that it decides."""

    purpose: Purpose
    film: Film  # of the pilot
    spp: int
    half_s: float  # CPU time of a half-estimate that the spec accepted, at which the pilot compared
    configuration_s: float  # this and the next one as in `ViewCost`; 0 for images
    view_s: float
    views: int
    max_depth: int
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[CandidateRow, ...]  # empty if every view is black
    shared: float  # as in `Choice`
    filled: tuple[float, ...]  # this and the next two as in `light_reach`
    near: tuple[tuple[float, ...], ...]
    power: tuple[tuple[float, ...], ...]
    asked_s: float  # CPU time that the pilot was given
    spent_s: float  # CPU time in all
    compiling_s: float  # the part for loading, kernels, and the images that give the weights

    @property
    def view_cost(self) -> ViewCost:
        """The CPU time of a sample beside its half-estimates."""
        return ViewCost(self.configuration_s, self.view_s)

    def knows(self, candidate: Candidate) -> bool:
        """Whether a candidate was measured."""
        return any(row.candidate == candidate for row in self.rows)

    def row(self, candidate: Candidate) -> CandidateRow:
        """The measurement of a candidate."""
        return next(row for row in self.rows if row.candidate == candidate)


@dataclass(frozen=True, slots=True)
class _Compared:
    """The comparison of candidates: the film and samples per pixel of the images, and the pilot's results."""

    film: Film
    spp: int
    half_s: float
    beside: ViewCost
    choice: pilot.Choice
    rows: tuple[CandidateRow, ...]
    notes: tuple[str, ...]  # sentences on what there was no time for


def measure(spec: SceneSpec, beside: Path | None, purpose: Purpose, seconds: float, log: Log) -> Measurement:
    """Load the scene of a spec and measure its light transport for a purpose, in `seconds` of CPU time for all of it.

    The spec's settings are always among the measured ones. Raises SpecError and BackendError as loading does,
    IncompleteError, with the time that it takes, if the time is too short.
    """
    budget = Budget(seconds)
    with WorkLog(log) as work_log:
        work_log.begin(f"loading {spec.name}", budget.words)
        pilot_scene = PilotScene(spec, beside)
        budget.require(f"{spec.name}: loading it", 0.0, budget.spent_s)
        found = content.read(pilot_scene.loaded.scene, pilot_scene.camera())
        work_log.begin(f"following the light of {spec.name}", budget.words)
        loaded_s = budget.spent_s
        reach = light_reach.measure(budget.within(REACH, pilot_scene.configurations(LIT), LEAST_LIT), spec.view, SEED)
        edit_s = (budget.spent_s - loaded_s) / len(reach.near)
        depth = spec.transport.max_depth
        candidates, left_out = content.restrict(found, depth, reach.hit, GRID)
        every = list(dict.fromkeys([*candidates, present(spec)]))
        compared = _compare(pilot_scene, every, purpose, edit_s, budget, work_log)
    spent = budget.spent_s
    return Measurement(
        purpose=purpose,
        film=compared.film,
        spp=compared.spp,
        half_s=compared.half_s,
        configuration_s=compared.beside.configuration_s,
        view_s=compared.beside.view_s,
        views=compared.choice.views,
        max_depth=depth,
        modelled=(*content.sentences(found, depth), *compared.notes),
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


def _compare(
    pilot_scene: PilotScene,
    every: list[Candidate],
    purpose: Purpose,
    edit_s: float,
    budget: Budget,
    work_log: WorkLog,
) -> _Compared:
    spec = pilot_scene.spec
    now, half_spp = present(spec), spec.transport.half_spp
    beside = _beside(pilot_scene, budget, work_log) if purpose is Purpose.TRAINING else FREE
    work_log.begin("compiling and timing images", budget.words)
    quick = _on_quick_film(pilot_scene, budget)
    what = f"{spec.name}: comparing settings"
    candidates = affordable(quick.renders(1)[0], every, {PLAIN, now} & set(every) or {now}, budget, edit_s, what)
    timed = time_images(quick.renders(1)[0], candidates, half_spp, TIMING * budget.left_s, quick.clock)
    pixels = spec.film.width * spec.film.height
    scale = pixels / (quick.spec.film.width * quick.spec.film.height)
    costs = {candidate: ImageCost(cost.fixed_s, scale * cost.sample_s) for candidate, cost in timed.items()}
    halves = {c: cost.of_a_half() if purpose is Purpose.TRAINING else cost for c, cost in costs.items()}
    half_s = halves[now].time_s(half_spp)
    left_s = max(budget.left_s - EDITS * LEAST_VIEWS * edit_s, 0.0)
    film, spp, views = _pilot_film(spec, costs, left_s)
    pilot_scene = quick.on_film(film)
    work_log.begin(
        f"measuring {len(candidates)} settings in {views} views of {film.width} × {film.height}, {spp} spp",
        budget.words,
    )
    pilot_spp = spp * film.width * film.height / pixels  # of the spec's film
    choice = pilot.choose(
        pilot_scene.renders(views),
        candidates,
        seconds=left_s,
        spp=spp,
        seed=SEED,
        keep=[c for c in (DEFAULT, now) if c in candidates],
        later={c: _images(halves[c], half_s, beside, spp) / cost.time_s(pilot_spp) for c, cost in costs.items()},
        weigh=purpose.weigh(spec.exposure),
        clock=pilot_scene.clock,
    )
    rows = tuple(
        _row(measured, costs[measured.candidate], halves[measured.candidate], pilot_spp, half_spp)
        for measured in choice.measured
    )
    fewer = f"settings compared: {len(candidates)} of {len(every)}, as --seconds {budget.seconds:g} allows no more"
    return _Compared(film, spp, half_s, beside, choice, rows, (fewer,) if len(candidates) < len(every) else ())


def _beside(pilot_scene: PilotScene, budget: Budget, work_log: WorkLog) -> ViewCost:
    work_log.begin("timing what a sample has beside its images", budget.words)
    return view_cost.measure(
        pilot_scene, budget.within(BESIDE, pilot_scene.draw(view_cost.MOST_VIEWS), view_cost.LEAST_VIEWS)
    )


def _on_quick_film(pilot_scene: PilotScene, budget: Budget) -> PilotScene:
    """The scene on a film whose images are quick to render, halved as often as it helps; not below 32 pixels."""
    target_s = budget.left_s / IMAGES
    before = np.inf
    while True:
        render, film = pilot_scene.renders(1)[0], pilot_scene.spec.film
        render(PLAIN, 0, 1)  # compiles
        begun = pilot_scene.clock()
        render(PLAIN, 1, 1)
        image_s = pilot_scene.clock() - begun
        if image_s <= target_s or min(film.width, film.height) < 64 or image_s > 0.7 * before:
            return pilot_scene
        before = image_s
        pilot_scene = pilot_scene.on_film(_halved(film))


def _halved(film: Film) -> Film:
    return Film(width=film.width // 16 * 8, height=film.height // 16 * 8)


def present(spec: SceneSpec) -> Candidate:
    """The present settings of a spec."""
    t = spec.transport
    return Candidate(t.connections, t.light_ratio, t.guided_light, t.light_samples)


def _images(half: ImageCost, half_s: float, beside: ViewCost, spp: int) -> float:
    """The CPU time until half-estimates that take `half_s` have the error of an image of `spp` samples per pixel.

    What else their samples take counts.
    """
    samples = half.bought(half_s)
    return spp / samples * (half.time_s(samples) + beside.half_s)


def _pilot_film(spec: SceneSpec, costs: Mapping[Candidate, ImageCost], seconds: float) -> tuple[Film, int, int]:
    """The film, samples per pixel and number of views whose first round takes no more than its share of the time.

    Film and samples are those of the spec if there is time for them, and there are as many views as there is time for.
    Otherwise samples are reduced first; then the film is halved, as long as the samples dominate the time.
    """
    fixed, sample = sum(cost.fixed_s for cost in costs.values()), sum(cost.sample_s for cost in costs.values())
    images = 2 + max(1.0, SCOUTS / len(costs))
    budget = FIRST_ROUND * seconds / images  # for one image of each candidate in each view
    spp = int(np.clip((budget / LEAST_VIEWS - fixed) / sample, 1, spec.transport.half_spp))
    film = spec.film
    while LEAST_VIEWS * (fixed + spp * sample) > budget and spp * sample > fixed and min(film.width, film.height) >= 64:
        film = _halved(film)
        sample /= 4
    return film, spp, int(np.clip(budget / (fixed + spp * sample), LEAST_VIEWS, MOST_VIEWS))


def _row(
    measured: MeasuredCandidate, cost: ImageCost, half: ImageCost, pilot_spp: float, half_spp: int
) -> CandidateRow:
    """A candidate's row: the cost of its half-estimates, corrected by the times of the pilot's many images.

    `cost` is that of an image as timed beforehand, and `half` that of a half-estimate which follows from it.

    Images of the pilot with far fewer samples correct nothing, as their fixed part hides the time of their samples.
    """
    similar = RANGE * pilot_spp >= half_spp
    correction = measured.time_s / cost.time_s(pilot_spp) if similar else 1.0
    return CandidateRow(
        connections=measured.candidate.connections,
        light_ratio=measured.candidate.light_ratio,
        guided_light=measured.candidate.guided_light,
        light_samples=measured.candidate.light_samples,
        errors=measured.errors,
        missed=measured.missed,
        fixed_s=correction * half.fixed_s,
        sample_s=correction * half.sample_s,
    )
