"""The measurement of a spec's scene: everything that a plan depends on, as it is kept on disk."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator
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
from photonfarm.farm.devices import CPU
from photonfarm.renderer.jobs.render import versions
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene, integrator_of
from photonfarm.renderer.scene.loading import AimedSensor
from photonfarm.renderer.strategy.budget import Budget, compile_within, time_images
from photonfarm.renderer.strategy.candidates import (
    DEFAULT,
    GRID,
    PLAIN,
    Candidate,
    ImageCost,
    MeasuredCandidate,
    Render,
    present_settings,
)
from photonfarm.renderer.strategy.content import LightReach, SceneContent, light_reach
from photonfarm.renderer.strategy.noise import Purpose
from photonfarm.renderer.strategy.pilot import SCOUTS, measure_errors
from photonfarm.scene.modification import Modification, rest, sample_modification
from photonfarm.scene.spec import Film, SceneSpec, Transport
from photonfarm.scene.view import View, sample_view

SEED = 0
"""The master seed of a pilot's configurations, views and images."""

FIRST_ROUND = 0.4
"""The largest share of the pilot's time for its first round: later rounds decide between the best."""

TIMING = 0.2
"""The share of the given time that is spent on timing images."""

LEAST_VIEWS, MOST_VIEWS = 3, 8

LIT = 6
"""The number of configurations in which light paths are traced, to see which photons are worth storing."""

IMAGES = 400
"""The number of images that the time should pay for: about as many as ten settings need at least."""

_DECIDED = ("connections", "light_ratio", "half_spp", "guided_light", "light_samples")
"""The settings that a plan decides."""


class Measurement(Frozen):
    """One pilot of one scene: all that a plan depends on besides the settings that it decides."""

    purpose: Purpose
    film: Film  # of the pilot
    spp: int  # of the pilot
    half_s: float  # CPU time of a half-estimate that the spec accepted, at which the pilot compared
    views: int
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]
    rows: tuple[MeasuredCandidate, ...]  # with costs of half-estimates on the spec's film; empty if all is black
    shared: float  # as in `PilotResult`
    reach: LightReach
    asked_s: float  # CPU time that the pilot was given
    spent_s: float  # CPU time in all
    device: str  # what rendered: the name of a card, or "cpu"

    @property
    def on_card(self) -> bool:
        """Whether a card rendered."""
        return self.device != CPU

    @property
    def costs(self) -> dict[Candidate, ImageCost]:
        """The costs of the measured candidates."""
        return {row.candidate: row.cost for row in self.rows}


class PilotScene:
    """A loaded scene that renders any candidate in any of its configurations. Not thread-safe, like `LoadedScene`."""

    def __init__(self, spec: SceneSpec, beside: Path | None) -> None:
        """Load the scene of a spec."""
        self.spec = spec
        self.loaded = LoadedScene.load(spec, beside)
        self._integrators: dict[Candidate, Any] = {}
        self._applied: Modification | None = None
        self._editing_s = 0.0

    def use_film(self, film: Film) -> None:
        """Render on another film from now on."""
        self.loaded.apply(rest(self.spec))
        self._integrators.clear()
        self._applied = None
        self.spec = self.spec.model_copy(update={"film": film})
        self.loaded = LoadedScene(self.spec, self.loaded.scene)

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

    def _render(self, modification: Modification, view: View, candidate: Candidate, seed: int, spp: int) -> F32:
        self._apply(modification)
        if self.spec.groups:
            self.loaded.forget_path_guides()  # a sample has them to learn, as with one view of each configuration
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
    budget, now, half_spp = Budget(seconds), present_settings(spec), spec.transport.half_spp
    with WorkLog(log) as work_log:
        work_log.begin(f"loading {spec.name}", budget.words)
        scene = PilotScene(spec, beside)
        budget.require(f"{spec.name}: loading it")
        work_log.begin(f"following the light of {spec.name}", budget.words)
        content, depth = SceneContent.of(scene.loaded.scene, AimedSensor(spec).sensor), spec.transport.max_depth
        reach = light_reach(scene.configurations(LIT), spec.view, SEED)
        pointless = content.why_no_light_paths(depth, reach.hit)

        every = list(dict.fromkeys([*([PLAIN] if pointless else GRID), now]))
        work_log.begin("compiling and timing images", budget.words)
        _shrink_film(scene, budget.left_s / IMAGES)
        film, renders = scene.spec.film, scene.renders(MOST_VIEWS)
        what = f"{spec.name}: comparing settings"
        candidates = compile_within(renders[0], every, {PLAIN, now}, budget, what)
        timed = time_images(renders[:LEAST_VIEWS], candidates, half_spp, TIMING * budget.left_s, scene.clock)
        shared_by = 2 if purpose is Purpose.TRAINING else 1  # the half-estimates of a launch share its fixed part
        scale = spec.film.width * spec.film.height / (film.width * film.height)
        costs = {c: ImageCost(cost.fixed_s / shared_by, scale * cost.sample_s) for c, cost in timed.items()}
        half_s = costs[now].time_s(half_spp)

        left_s = max(budget.left_s, 0.0)
        images = 2 + max(1.0, SCOUTS / len(timed))  # of each candidate in each view: a pair, and its share of scouts
        image_s = FIRST_ROUND * left_s / images  # for one of each candidate in each view
        fixed_s, sample_s = sum(cost.fixed_s for cost in timed.values()), sum(cost.sample_s for cost in timed.values())
        spp = int(np.clip((image_s / LEAST_VIEWS - fixed_s) / sample_s, 1, half_spp))
        views = int(np.clip(image_s / (fixed_s + spp * sample_s), LEAST_VIEWS, MOST_VIEWS))
        what = f"{len(candidates)} settings in {views} views of {film.width} × {film.height}, {spp} spp"
        work_log.begin(f"measuring {what}", budget.words)
        found = measure_errors(
            renders[:views],
            costs,
            later_s=half_s,
            seconds=left_s,
            spp=spp,
            seed=SEED,
            keep=[c for c in (DEFAULT, now) if c in candidates],
            weigh=purpose.weigh(spec.exposure),
        )
    fewer = f"settings compared: {len(candidates)} of {len(every)}, as --seconds {seconds:g} allows no more"
    return Measurement(
        purpose=purpose,
        film=film,
        spp=spp,
        half_s=half_s,
        views=found.views,
        modelled=(*content.sentences(depth), *[fewer] * (len(candidates) < len(every))),
        left_out=(f"light paths, and with them connections: {pointless}",) if pointless else (),
        rows=found.measured,
        shared=found.shared,
        reach=reach,
        asked_s=seconds,
        spent_s=budget.spent_s,
        device=backend.device().name,
    )


def _shrink_film(scene: PilotScene, target_s: float) -> None:
    """Have a film whose images are quick to render, halved as often as it helps; not below 32 pixels."""
    before = np.inf
    while True:
        render, film = scene.renders(1)[0], scene.spec.film
        render(PLAIN, 0, 1)  # compiles
        begun = scene.clock()
        render(PLAIN, 1, 1)
        image_s = scene.clock() - begun
        if image_s <= target_s or min(film.width, film.height) < 64 or image_s > 0.7 * before:
            return
        before = image_s
        scene.use_film(Film(width=film.width // 16 * 8, height=film.height // 16 * 8))  # half, a multiple of 8


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
