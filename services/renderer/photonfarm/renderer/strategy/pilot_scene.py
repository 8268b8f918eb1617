"""The scene of a pilot: a loaded scene, some configurations of it, and a view of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene, integrator_of
from photonfarm.renderer.scene.sensor import AimedSensor
from photonfarm.renderer.strategy.candidate import Candidate, Render
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.modification import Modification, rest, sample_modification
from photonfarm.shared.scene.spec import Film, SceneSpec
from photonfarm.shared.scene.view import View, sample_view

SEED = 0
"""The master seed of a pilot's configurations, views and images."""


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

    def draw(self, count: int) -> Iterator[tuple[Modification, View]]:
        """Some configurations, and a view of each; always the same."""
        for i in range(count):
            modification = sample_modification(self.spec, SEED, i)
            yield modification, sample_view(self.spec, modification.key(self.spec.radiance_id), SEED, i, modification)

    def renders(self, count: int) -> list[Render]:
        """A function for each of some configurations; it renders one view of it."""
        return [partial(self._render, *drawn) for drawn in self.draw(count)]

    def configurations(self, count: int) -> Iterator[Any]:
        """The Mitsuba scene in each of the same configurations, in turn."""
        for modification, _ in self.draw(count):
            self.apply(modification)
            yield self.loaded.scene

    def camera(self) -> Any:
        """Mitsuba's sensor, in any direction."""
        return AimedSensor(self.spec).sensor

    def _render(self, modification: Modification, view: View, candidate: Candidate, seed: int, spp: int) -> F32:
        self.apply(modification)
        if self.spec.groups:
            self.loaded.forget_guides()  # a sample has them to learn, as with one view of each configuration
        if candidate not in self._integrators:
            settings = asdict(candidate)
            self._integrators[candidate] = integrator_of(self.spec.transport.model_copy(update=settings))
        return self.loaded.render(view, seed, self._integrators[candidate], spp)

    def apply(self, modification: Modification) -> None:
        """Bring the scene into a configuration, unless that object is the one that it is in."""
        if modification is not self._applied:
            start = backend.work_s()
            self.loaded.apply(modification)
            self._applied = modification
            self._editing_s += backend.work_s() - start
