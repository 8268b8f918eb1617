"""Hard scenes: their description, their truth, and the effort to compare both.

Shape letters: K renders, H W image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

SceneDict = dict[str, Any]
"""A dictionary for ``mi.load_dict``."""
Images = NDArray[np.floating[Any]]
"""[K, H, W, 3] linear radiance of K independent renders; K = 1 stands for an image that is known exactly."""


@dataclass(frozen=True, slots=True)
class BdptSettings:
    """The technique counts of `bdpt`."""

    connections: int
    light_ratio: float
    guided_light: bool = False

    def __str__(self) -> str:
        return f"{self.connections},{self.light_ratio:g}" + ",guided" * self.guided_light

    @property
    def parameters(self) -> dict[str, Any]:
        """The settings as the plugin takes them."""
        return asdict(self)


FIRST = BdptSettings(1, 1.0)
"""The settings of the quick version."""
GUIDED = BdptSettings(1, 1.0, guided_light=True)
"""The same with guided light paths."""
ALL = (FIRST, GUIDED, BdptSettings(0, 0.0), BdptSettings(0, 1.0), BdptSettings(4, 0.25), BdptSettings(1, 1.5))
"""The settings of the long version; each is complete if paths from the eye find everything."""
EYE_ALONE = (BdptSettings(0, 0.0),)
"""A path tracer, for scenes in which nothing can be done from the light side."""
WITH_LIGHT_PATHS = tuple(settings for settings in ALL if settings.light_ratio > 0)
"""The settings that are complete also if light must be followed from its source."""


@dataclass(frozen=True, slots=True)
class Effort:
    """The amount of rendering and the required precision of a comparison."""

    size: int  # pixels, square
    blocks: int  # the image is compared in blocks × blocks
    seeds: int  # independent renders, of bdpt and of the truth
    spp: int  # samples per pixel of one render of bdpt
    truth_spp: int  # samples per pixel of one render of the truth
    resolution: float  # largest standard error of the mean ratio with which a pass counts


QUICK = Effort(size=16, blocks=4, seeds=12, spp=64, truth_spp=128, resolution=0.01)
LONG = Effort(size=32, blocks=8, seeds=16, spp=128, truth_spp=384, resolution=0.003)


@dataclass(frozen=True, slots=True)
class Truth:
    """The truth with which an image is compared."""

    name: str  # in words, for the table
    images: Callable[[HardScene, Effort, int], Images]  # function of a scene, an effort and a seed


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


# ------------------------------------------------ Scenes ------------------------------------------------


@dataclass(frozen=True, slots=True)
class HardScene:
    """One scene that breaks bidirectional path tracers, with its truth."""

    row: int  # number in the table of hard scenes, 1 … 36
    name: str
    build: Callable[[int], SceneDict]  # function of the image size; its docstring says what is hard
    truth: Truth = PATH
    hard: str = ""  # what is hard about it instead
    max_depth: int = 6
    rr_depth: int = 5
    settings: tuple[BdptSettings, ...] = ALL
    quick_settings: tuple[BdptSettings, ...] = (FIRST,)  # some of them
    quick: Effort | None = QUICK  # None: the long version only
    long: Effort = LONG
    edit: Callable[[Any], None] | None = None  # changes the loaded scene in place before it is rendered
    max_over_mean: float | None = None  # largest pixel of any render over the mean, where the row bounds it

    @property
    def label(self) -> str:
        """Number and name, as `--only` takes them."""
        return f"{self.row:02d}-{self.name}"

    @property
    def what_is_hard(self) -> str:
        """What is hard about it, in a sentence."""
        return self.hard or (self.build.__doc__ or "").partition("\n")[0].rstrip(".")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A scene that would be rendered wrongly, and is refused instead."""

    row: int | None  # number in the table of hard scenes, None where it has none
    name: str
    build: Callable[[int], SceneDict]
    sentence: str  # a part of the required message
    settings: BdptSettings = FIRST
    allowed: BdptSettings | None = None  # settings with which it is rendered nevertheless

    @property
    def label(self) -> str:
        """Number and name, as `--only` takes them."""
        return f"{self.row:02d}-{self.name}" if self.row else self.name
