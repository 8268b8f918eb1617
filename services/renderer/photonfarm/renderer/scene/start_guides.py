"""Guides of light paths, one for each configuration: they follow from its content key alone, as its views do.

So both halves of a sample, every view and every worker have the same guide, and none of them shares a random number
with it. It is learned from a few views that are drawn as those of samples are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from photonfarm.core.keys import seed_of
from photonfarm.renderer.bdpt.guiding.learning import Effort
from photonfarm.renderer.scene.loading import AimedSensor
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import sample_view

VIEWS = 4
"""The views that a guide is learned from."""

PURPOSE = "guide of light paths"

STATIC = 16
"""The samples that a guide is learned for, where there is a single configuration; else it is one."""


class SceneGuides:
    """The guides of the configuration that a scene is in, one for each integrator; they are learned when needed."""

    def __init__(self, spec: SceneSpec, sensor: AimedSensor) -> None:
        """Have none yet."""
        self._spec, self._sensor = spec, sensor
        self._learned: dict[Any, Any] = {}
        self._state: Modification | None = None

    def of(self, integrator: Any, scene: Any, state: Modification) -> Any:
        """The guide of an integrator in a configuration; None for one that is not guided."""
        if not getattr(integrator, "guided_light", False):
            return None
        if self._state is None or not np.array_equal(self._state.vector, state.vector):
            self.forget()
            self._state = state
        if integrator not in self._learned:
            self._learned[integrator] = self._learn(integrator, scene, state)
        return self._learned[integrator]

    def forget(self) -> None:
        """Learn all anew."""
        self._learned.clear()

    def _learn(self, integrator: Any, scene: Any, state: Modification) -> Any:
        spec = self._spec
        key = state.key(spec.radiance_id)
        seed = seed_of(key, PURPOSE)
        views = [sample_view(spec, key, seed, i, state) for i in range(VIEWS)]
        places = np.stack([self._sensor.place(view) for view in views])
        eye_paths = 2 * spec.film.width * spec.film.height * spec.transport.half_spp
        images = 1 if spec.groups else STATIC
        effort = Effort.for_image(eye_paths * images, integrator.light_ratio, integrator.connections)
        return integrator.learn_guide(scene, self._sensor.at_origin, seed, places, effort)
