"""The measurement of a spec's scene: everything that a plan depends on, as it is kept on disk."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from photonfarm.core.files import write_whole
from photonfarm.core.keys import make_key
from photonfarm.core.models import Frozen
from photonfarm.core.records import F32
from photonfarm.core.waiting import Log, WorkLog
from photonfarm.renderer.jobs.render import versions
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene, integrator_of
from photonfarm.renderer.scene.loading import AimedSensor
from photonfarm.renderer.strategy import content, pilot
from photonfarm.renderer.strategy.budget import EDITS, LEAST_VIEWS, RANGE, Budget, ImageCost, affordable, time_images
from photonfarm.renderer.strategy.candidates import DEFAULT, GRID, PLAIN, Candidate, RelativeErrors, Render, present
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import SCOUTS
from photonfarm.scene.modification import Modification, rest, sample_modification
from photonfarm.scene.spec import Film, SceneSpec, Transport
from photonfarm.scene.view import View, sample_view

SEED = 0
"""The master seed of a pilot's configurations, views and images."""

FIRST_ROUND = 0.4
"""The largest share of the pilot's time for its first round: later rounds decide between the best."""

TIMING = 0.2
"""The share of the given time that is spent on timing images."""

MOST_VIEWS = 8

LIT, LEAST_LIT, REACH = 16, 2, 0.25
"""The number of configurations in which light paths are traced, to see which photons are worth storing: 16, or as many,
at least 2, as a quarter of the time allows, with what went before."""

IMAGES = 400
"""The number of images that the time should pay for: about as many as ten settings need at least."""

_DECIDED = ("connections", "light_ratio", "half_spp", "guided_light", "light_samples")
"""The settings that a plan decides."""


class CandidateRow(Frozen):
    """One candidate, as the pilot measured it."""

    candidate: Candidate
    errors: RelativeErrors  # of images of `Measurement.spp`
    missed: float  # as in `MeasuredCandidate`
    cost: ImageCost  # of a half-estimate on the spec's film


class Measurement(Frozen):
    """One pilot of one scene: all that a plan depends on besides the settings that it decides."""

    purpose: Purpose
    film: Film  # of the pilot
    spp: int
    half_s: float  # CPU time of a half-estimate that the spec accepted, at which the pilot compared
    views: int
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[CandidateRow, ...]  # empty if every view is black
    shared: float  # as in `Choice`
    near: tuple[tuple[float, ...], ...]  # this and the next one as in `LightReach`
    power: tuple[tuple[float, ...], ...]
    asked_s: float  # CPU time that the pilot was given
    spent_s: float  # CPU time in all

    def row(self, candidate: Candidate) -> CandidateRow:
        """The measurement of a candidate."""
        return next(row for row in self.rows if row.candidate == candidate)


class PilotScene:
    """A loaded scene that renders any candidate in any of its configurations. Not thread-safe, like `LoadedScene`."""

    def __init__(self, spec: SceneSpec, beside: Path | None, loaded: LoadedScene | None = None) -> None:
        """Load the scene of a spec, on a film as small as the pilot requires, or take the loaded one."""
        self.spec = spec
        self.loaded = loaded or LoadedScene.load(spec, beside)
        self._integrators: dict[Candidate, Any] = {}
        self._applied: Modification | None = None
        self._editing_s = 0.0

    def on_film(self, film: Film) -> PilotScene:
        """The same scene on another film, without loading it again; after that, only the new one may be used."""
        if film == self.spec.film:
            return self
        self.loaded.apply(rest(self.spec))
        spec = self.spec.model_copy(update={"film": film})
        return PilotScene(spec, None, LoadedScene(spec, self.loaded.scene))

    def clock(self) -> float:
        """The seconds of `backend.work_s` without those of edits, which cost all candidates the same."""
        return backend.work_s() - self._editing_s

    def _draw(self, count: int) -> Iterator[tuple[Modification, View]]:
        """Some configurations, and a view of each; always the same."""
        for i in range(count):
            modification = sample_modification(self.spec, SEED, i)
            yield modification, sample_view(self.spec, modification.key(self.spec.radiance_id), SEED, i, modification)

    def renders(self, count: int) -> list[Render]:
        """A function for each of some configurations; it renders one view of it."""
        return [partial(self._render, *drawn) for drawn in self._draw(count)]

    def configurations(self, count: int) -> Iterator[Any]:
        """The Mitsuba scene in each of the same configurations, in turn."""
        for modification, _ in self._draw(count):
            self._apply(modification)
            yield self.loaded.scene

    def camera(self) -> Any:
        """Mitsuba's sensor, in any direction."""
        return AimedSensor(self.spec).sensor

    def _render(self, modification: Modification, view: View, candidate: Candidate, seed: int, spp: int) -> F32:
        self._apply(modification)
        if self.spec.groups:
            self.loaded.forget_guides()  # a sample has them to learn, as with one view of each configuration
        if candidate not in self._integrators:
            settings = asdict(candidate)
            self._integrators[candidate] = integrator_of(self.spec.transport.model_copy(update=settings))
        return self.loaded.render(view, seed, self._integrators[candidate], spp)

    def _apply(self, modification: Modification) -> None:
        """Bring the scene into a configuration, unless that object is the one that it is in."""
        if modification is not self._applied:
            start = backend.work_s()
            self.loaded.apply(modification)
            self._applied = modification
            self._editing_s += backend.work_s() - start


def measure(spec: SceneSpec, beside: Path | None, purpose: Purpose, seconds: float, log: Log) -> Measurement:
    """Load the scene of a spec and measure its light transport for a purpose, in `seconds` of CPU time for all of it.

    The spec's settings are always among the measured ones. Raises SpecError and BackendError as loading does,
    IncompleteError, with the time that it takes, if the time is too short.
    """
    budget = Budget(seconds)
    with WorkLog(log) as work_log:
        work_log.begin(f"loading {spec.name}", budget.words)
        scene = PilotScene(spec, beside)
        budget.require(f"{spec.name}: loading it", 0.0, budget.spent_s)
        work_log.begin(f"following the light of {spec.name}", budget.words)
        scene_content, depth = content.read(scene.loaded.scene, scene.camera()), spec.transport.max_depth
        loaded_s = budget.spent_s
        reach = content.light_reach(budget.take_within(REACH, scene.configurations(LIT), LEAST_LIT), spec.view, SEED)
        edit_s = (budget.spent_s - loaded_s) / len(reach.near)
        useful, left_out = content.restrict(scene_content, depth, reach.hit, GRID)

        now, half_spp = present(spec), spec.transport.half_spp
        every = list(dict.fromkeys([*useful, now]))
        work_log.begin("compiling and timing images", budget.words)
        scene = _shrink_film(scene, budget)
        render, first = scene.renders(1)[0], {PLAIN, now} & set(every)
        candidates = affordable(render, every, first, budget, edit_s, f"{spec.name}: comparing settings")
        pixels, quick = spec.film.width * spec.film.height, scene.spec.film
        timed = time_images(render, candidates, half_spp, TIMING * budget.left_s, scene.clock)
        scale = pixels / (quick.width * quick.height)
        costs = {c: ImageCost(cost.fixed_s, scale * cost.sample_s) for c, cost in timed.items()}
        halves = {c: cost.halve() if purpose is Purpose.TRAINING else cost for c, cost in costs.items()}
        half_s = halves[now].time_s(half_spp)

        left_s = max(budget.left_s - EDITS * LEAST_VIEWS * edit_s, 0.0)
        film, spp, views = _pilot_film(spec, costs, left_s)
        scene = scene.on_film(film)
        what = f"{len(candidates)} settings in {views} views of {film.width} × {film.height}, {spp} spp"
        work_log.begin(f"measuring {what}", budget.words)
        pilot_spp = spp * film.width * film.height / pixels  # of the spec's film
        choice = pilot.choose(
            scene.renders(views),
            candidates,
            seconds=left_s,
            spp=spp,
            seed=SEED,
            keep=[c for c in (DEFAULT, now) if c in candidates],
            later={c: spp * halves[c].per_sample_s(half_s) / cost.time_s(pilot_spp) for c, cost in costs.items()},
            weigh=purpose.weigh(spec.exposure),
            clock=scene.clock,
        )
    fewer = f"settings compared: {len(candidates)} of {len(every)}, as --seconds {seconds:g} allows no more"
    similar = RANGE * pilot_spp >= half_spp  # where an image's fixed part does not hide the time of its samples
    corrections = {
        m.candidate: m.time_s / costs[m.candidate].time_s(pilot_spp) if similar else 1.0 for m in choice.measured
    }
    return Measurement(
        purpose=purpose,
        film=film,
        spp=spp,
        half_s=half_s,
        views=choice.views,
        modelled=(*content.sentences(scene_content, depth), *[fewer] * (len(candidates) < len(every))),
        left_out=tuple(left_out),
        rows=tuple(
            CandidateRow(
                candidate=measured.candidate,
                errors=measured.errors,
                missed=measured.missed,
                cost=halves[measured.candidate].times(corrections[measured.candidate]),
            )
            for measured in choice.measured
        ),
        shared=choice.shared,
        near=reach.near,
        power=reach.power,
        asked_s=seconds,
        spent_s=budget.spent_s,
    )


def _shrink_film(pilot_scene: PilotScene, budget: Budget) -> PilotScene:
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
        pilot_scene = pilot_scene.on_film(_halve(film))


def _halve(film: Film) -> Film:
    return Film(width=film.width // 16 * 8, height=film.height // 16 * 8)


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
        film = _halve(film)
        sample /= 4
    return film, spp, int(np.clip(budget / (fixed + spp * sample), LEAST_VIEWS, MOST_VIEWS))


# -------------------------------------------------------------------------------------- kept measurements


def digest(spec: SceneSpec, purpose: Purpose) -> str:
    """32 hexadecimal digits: the scene without what a plan decides, the purpose, the candidates, machine, and code.

    So a plan that is written into its spec does not require another one.
    """
    default = Transport()
    undecided = spec.transport.model_copy(update={name: getattr(default, name) for name in _DECIDED})
    scene = spec.model_copy(update={"transport": undecided})
    known = scene.radiance_id, str(undecided.rr_depth), repr(spec.exposure)
    return digest_here("scene plan", *known, repr(GRID), purpose.value)


def find(spec: SceneSpec, purpose: Purpose) -> Measurement | None:
    """The kept measurement of this scene for a purpose; None if it is missing, unreadable or unusable."""
    try:
        return Measurement.model_validate_json(file_of("plans", digest(spec, purpose)).read_bytes())
    except (OSError, ValidationError):
        return None


def keep(spec: SceneSpec, measurement: Measurement) -> Path:
    """Keep a measurement; returns its file, which appears whole. Raises OSError if it cannot be written."""
    file = file_of("plans", digest(spec, measurement.purpose))
    write_whole(file, measurement.model_dump_json(indent=1) + "\n")
    return file


def digest_here(*parts: str) -> str:
    """32 hexadecimal digits: the `parts` that identify a measurement, the machine, and all code that renders."""
    return make_key(*parts, repr(_machine()), _revision()).hex()


def _machine() -> tuple[object, ...]:
    """All that times depend on beside the scene and the code: processor, cores, device, versions of the packages.

    The number of threads is not among them, as a pilot has one.
    """
    device = backend.device()
    return _processor(), os.cpu_count(), device.variant, device.name, sorted(versions().items())


def _processor() -> str:
    """The model's name, if the system states it; else its kind."""
    try:
        described = Path("/proc/cpuinfo").read_text()
    except OSError:
        described = ""
    names = [line.partition(":")[2].strip() for line in described.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _revision() -> bytes:
    """A digest of the renderer's source: a checkout has one version for many renderers.

    It leaves out how configurations and views are drawn: that never changes, since the keys of stored samples depend on
    it.
    """
    hashed = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        hashed.update(file.read_bytes())
    return hashed.digest()


def file_of(folder: str, digest: str) -> Path:
    """The file of a measurement; each kind has a folder of its own."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "photonfarm" / folder / f"{digest}.json"
