"""Truths: numbers and images known in closed form, and renders by integrators that are right on the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from tests.stability.scenes.case import Effort, HardScene, Images, SceneDict, Truth

LANES = 1 << 20
"""The largest number of samples of one launch, which bounds the memory of Mitsuba's own integrators."""
TRUTH_SEEDS = 1_000_000
"""The first seed of truths, above those of bdpt."""
GRID = 24
"""The points per pixel and axis over which a known image is averaged."""


def render(scene: Any, integrator: dict[str, Any], spp: int, seeds: range) -> Images:
    """[K, H, W, 3] float32: one image for each seed, of a loaded scene.

    Renders of more than `LANES` samples are means of several, as many independent seeds.
    """
    plugin = mi.load_dict(integrator)
    width, height = scene.sensors()[0].film().crop_size()
    parts = -(-width * height * spp // LANES)
    if parts == 1 and hasattr(plugin, "render_seeds"):  # `bdpt`: the same images in fewer launches
        return np.array(plugin.render_seeds(scene, scene.sensors()[0], seeds, spp))

    def image(seed: int) -> Any:
        each = [
            np.array(plugin.render(scene, seed=seed * parts + part, spp=-(-spp // parts)))[..., :3]
            for part in range(parts)
        ]
        return each[0] if parts == 1 else np.mean(each, axis=0, dtype=np.float64)

    return np.stack([image(seed) for seed in seeds])


def load(scene: SceneDict) -> Any:
    """The scene loaded with one shape for each entry."""
    return mi.load_dict(scene, optimize=False)


def _truth_seeds(effort: Effort, seed: int) -> range:
    return range(TRUTH_SEEDS + seed, TRUTH_SEEDS + seed + effort.seeds)


# ------------------------------------------------ Renders ------------------------------------------------


def rendered(integrator: str, name: str, build: Callable[[int], SceneDict] | None = None, **parameters: Any) -> Truth:
    """Images by one of Mitsuba's integrators, of the scene itself or of the one that ``build`` describes instead.

    Depth and roulette are the scene's own unless given.
    """

    def images(scene: HardScene, effort: Effort, seed: int) -> Images:
        settings = {"max_depth": scene.max_depth, "rr_depth": scene.rr_depth, **parameters}
        loaded = load((build or scene.build)(effort.size))
        return render(loaded, {"type": integrator, **settings}, effort.truth_spp, _truth_seeds(effort, seed))

    return Truth(name, images)


PATH = rendered("path", "`path`")


def crop_of_full_image(full: Callable[[int], SceneDict], rows: slice, columns: slice) -> Truth:
    """The part of the whole image, by `path`, that the scene's crop window shows (fractions of 16 pixels)."""

    def images(scene: HardScene, effort: Effort, seed: int) -> Images:
        whole = rendered("path", "", full).images(scene, effort, seed)
        unit = effort.size // 16
        return whole[:, _scaled(rows, unit), _scaled(columns, unit)]

    return Truth("the same crop of the full image by `path`", images)


def _scaled(part: slice, unit: int) -> slice:
    return slice(part.start * unit, part.stop * unit)


def same_by_bdpt(build: Callable[[int], SceneDict], name: str) -> Truth:
    """Images by `bdpt` itself, of a scene that must look the same."""

    def images(scene: HardScene, effort: Effort, seed: int) -> Images:
        integrator = {"type": "bdpt", "max_depth": scene.max_depth, "rr_depth": scene.rr_depth}
        return render(load(build(effort.size)), integrator, effort.spp, _truth_seeds(effort, seed))

    return Truth(name, images)


# ------------------------------------------------ Closed forms ------------------------------------------------


def known(value: float, name: str) -> Truth:
    """The truth of a scene whose pixels and channels all have one value."""

    def images(scene: HardScene, effort: Effort, seed: int) -> Images:
        return np.full((1, effort.size, effort.size, 3), value)

    return Truth(name, images)


def known_on_plane(radiance: Callable[[Any], Any], name: str) -> Truth:
    """The truth of the plane z = 0, seen by the scene's camera; ``radiance`` maps points on it, [N, 3], to [N]."""

    def images(scene: HardScene, effort: Effort, seed: int) -> Images:
        sensor = load(scene.build(effort.size)).sensors()[0]
        n = effort.size * GRID
        at = (np.arange(n, dtype=np.float32) + 0.5) / n
        x, y = (np.ascontiguousarray(part.ravel()) for part in np.meshgrid(at, at))
        ray, _ = sensor.sample_ray(0, 0, mi.Point2f(mi.Float(x), mi.Float(y)), mi.Point2f(0.5))
        o, d = np.array(ray.o, dtype=np.float64).T, np.array(ray.d, dtype=np.float64).T
        values = radiance(o - d * (o[:, 2:] / d[:, 2:]))
        pixels = values.reshape(effort.size, GRID, effort.size, GRID).mean(axis=(1, 3))
        return np.repeat(pixels[None, :, :, None], 3, axis=-1)

    return Truth(name, images)
