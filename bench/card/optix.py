"""Equal time with the OptiX denoiser, apart from others: its call ends the process where its weights are missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.card import equal_time
from bench.card.rooms import on_card
from photonfarm.core.errors import SpecError

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene
    from photonfarm.scene.view import View

TITLE = "Equal time, OptiX"
describe = equal_time.describe


def measure(name: str, size: int, out: Path, _limit_s: float) -> dict[str, Any]:
    """Measure this denoiser alone, as `equal_time.measure` does. Raises SpecError without a card."""
    if not on_card():
        raise SpecError("OptiX needs a card, and a processor renders here")
    import mitsuba as mi

    rendered = equal_time.RenderedRoom(name, size, out)
    optix = mi.OptixDenoiser([size, size], albedo=True, normals=True)

    def denoise(colour: Any, albedo: Any, normal: Any) -> Any:
        return np.array(optix(*(mi.TensorXf(image) for image in (colour, albedo, normal))), np.float32)

    row = rendered.errors(equal_time.PLAIN, denoise, guide_in_sensor_space)
    return {"size": size, "rows": {"OptiX, albedo": row}}


def guide_in_sensor_space(scene: LoadedScene, view: View) -> equal_time.Guide:
    """Diffuse albedo, and normals as the denoiser wants them."""
    from photonfarm.renderer.scene.loading import AimedSensor

    albedo, normal = equal_time.guide_by_albedo(scene, view)
    to_world = np.array(AimedSensor(scene.spec).aim(view).world_transform().matrix, np.float32).reshape(4, 4)
    return albedo, normal @ to_world[:3, :3]
