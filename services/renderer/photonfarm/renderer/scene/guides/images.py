"""The guides of a view: means over the rays of each pixel.

Shape letters: H W image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key, Stream
from photonfarm.core.records import F32, Guides
from photonfarm.renderer.bdpt.lights.emission import read_lights
from photonfarm.renderer.scene.arrays import floats, points
from photonfarm.renderer.scene.gbuffer import GRID, RAYS
from photonfarm.renderer.scene.guides.pattern import FOLLOWED, NO_LIMIT, SUB_PIXELS, GuideSettings, pattern_of
from photonfarm.renderer.scene.guides.specular_paths import trace
from photonfarm.renderer.scene.materials import Materials
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.view import Camera, View

if TYPE_CHECKING:
    from photonfarm.renderer.bdpt.recording import Recorder

PURPOSE = "direct"
"""The purpose of the seed of direct light, which is derived from the view's key."""


def view_guides(
    scene: Any,
    view: View,
    spec: SceneSpec,
    wanted: GuideSpec,
    key: Key,
    materials: Materials,
    arrives: F32,
    recorder: Recorder | None = None,
) -> Guides:
    """The guides of a view in the scene's present configuration; `key` is the view's.

    `arrives` is the result of `point_light`. With a `recorder` of `trace` Python runs only once for all views.
    """
    camera, spec = Camera.of(view, spec), spec.model_copy(update={"guides": wanted})
    pixels = camera.height * camera.width
    directions = _grid(camera)
    shifts = Stream(key, PURPOSE).uniform(pixels, 3).astype(np.float32)
    at_once = max(1, RAYS // SUB_PIXELS)  # pixels
    blocks = [slice(start, start + at_once) for start in range(0, pixels, at_once)]
    parts = [_trace(scene, camera, spec, (directions[block], shifts[block]), materials, recorder) for block in blocks]
    sums = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return _guides(sums, camera, arrives)


def _grid(camera: Camera) -> F32:
    """Unit directions through the grid of each pixel, (H·W, 16, 3)."""
    steps = (np.arange(GRID) + 0.5) / GRID
    within = [camera.rays(u, v).reshape(-1, 3) for v in steps for u in steps]
    return np.stack(within, axis=1)


def _trace(
    scene: Any, camera: Camera, spec: SceneSpec, given: tuple[F32, F32], materials: Materials, recorder: Recorder | None
) -> dict[str, NDArray[np.float64]]:
    """Sums over the grids of some pixels, (pixels, channels), by name; see `trace`."""
    directions, shifts = given[0].reshape(-1, 3), np.repeat(given[1], SUB_PIXELS, axis=0)
    along = directions.astype(np.float64) @ camera.forward  # cosine to the forward axis
    near, far = spec.view.near / along, spec.view.far / along
    rays = points(camera.origin + directions * near[:, None]), mi.Vector3f(points(directions)), floats(far - near)
    lights = read_lights(scene) if scene.emitters() else None
    settings = GuideSettings(
        spec.guides.light_samples if lights is not None else 0,
        FOLLOWED if materials.has_pure_deltas else 0,
        spec.transport.max_depth if spec.transport.max_depth >= 0 else NO_LIMIT,
        spec.view.near,
        materials.has_other_lobes,
    )
    of_bsdfs = floats(materials.roughness), floats(materials.diffuse_kept)
    tables = *of_bsdfs, *(floats(column) for column in pattern_of(settings.light_samples).T)
    arguments = lights, tables, *rays, floats(along), points(shifts), settings
    kind = (len(along), settings, lights.kinds if lights else None)
    columns = recorder(kind, scene, None, *arguments) if recorder else trace(scene, None, *arguments)
    return {name: _rows(column).reshape(len(given[0]), SUB_PIXELS, -1).sum(1) for name, column in columns.items()}


def _rows(column: Any) -> NDArray[np.float64]:
    values = np.array(column, np.float64)
    return values.T if values.ndim > 1 else values


def _guides(sums: dict[str, NDArray[np.float64]], camera: Camera, arrives: F32) -> Guides:
    """The guides, given the sums over each pixel's rays."""

    def image(values: NDArray[np.float64]) -> F32:
        shaped = values.reshape(camera.height, camera.width, -1).astype(np.float32)
        return shaped[..., 0] if shaped.shape[-1] == 1 else shaped

    def divide(name: str, count: str) -> F32:
        return image(sums[name] / np.maximum(sums[count], 1))

    mean = {name: values / SUB_PIXELS for name, values in sums.items()}
    return Guides(
        emission=image(mean["emission"]),
        direct=image(mean["direct"]),
        gloss=image(mean["gloss"]),
        specular=image(np.maximum(mean["specular"], 0)),
        roughness=image(mean["roughness"]),
        mean_depth=divide("depth", "hits"),
        mean_normal=image(mean["normal"]),
        throughput=image(mean["throughput"]),
        beyond_albedo=divide("beyond_albedo", "beyond"),
        beyond_normal=divide("beyond_normal", "beyond"),
        beyond_depth=divide("beyond_depth", "beyond"),
        point_light=arrives,
    )
