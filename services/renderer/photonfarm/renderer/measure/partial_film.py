"""Images of 1/k of the pixels: the cost of rendering only the pixels that a method keeps.

They stand for some pixels of the whole image: the same field of view on a smaller film, with as many light paths as the
whole image has, since their splats cannot be limited to some of its pixels. The integrator allows 64 light paths per
eye path at most, so that the cost of an image that would need more is too low. Sides are rounded to whole pixels, so
that the image may have a few more or fewer than 1/k.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from photonfarm.renderer.scene.loaded_scene import integrator_of
from photonfarm.renderer.scene.sensor import AimedSensor
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import View

MOST_LIGHT_PATHS = 64.0
"""The most light paths per eye path that the integrator allows."""


class PartialFilm:
    """About 1/k of the pixels of a spec's film, and their integrator; k = 1 gives the spec's own images."""

    def __init__(self, spec: SceneSpec, k: int) -> None:
        self.spec = part_of(spec, k)
        self._sensor = AimedSensor(self.spec)
        self._integrator = integrator_of(self.spec.transport)

    def render(self, scene: Any, view: View, seed: int) -> F32:
        """One half-estimate of linear radiance of a Mitsuba scene, (h, w, 3)."""
        half_spp = self.spec.transport.half_spp
        images = self._integrator.render_seeds(scene, self._sensor.aim(view), (seed,), half_spp)
        return np.array(images, np.float32)[0]


def part_of(spec: SceneSpec, k: int) -> SceneSpec:
    """The spec with about 1/k of the pixels, in about the same proportions, and as many light paths in all."""
    pixels = spec.film.width * spec.film.height
    height = max(1, round(spec.film.height / sqrt(k)))
    width = max(1, round(pixels / (k * height)))
    light_ratio = min(spec.transport.light_ratio * pixels / (width * height), MOST_LIGHT_PATHS)
    film = spec.film.model_copy(update={"width": width, "height": height})  # sides need not be divisible by 8
    transport = spec.transport.model_copy(update={"light_ratio": light_ratio})
    return spec.model_copy(update={"film": film, "transport": transport})
