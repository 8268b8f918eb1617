"""Hard scenes: their description, their truth, and the effort to compare both.

Shape letters: K renders, H W image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

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


@dataclass(frozen=True, slots=True)
class HardScene:
    """One scene that breaks bidirectional path tracers, with its truth."""

    row: int  # number in the table of hard scenes, 1 … 36
    name: str
    hard: str  # what is hard about it
    build: Callable[[int], SceneDict]  # function of the image size
    truth: Truth
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
