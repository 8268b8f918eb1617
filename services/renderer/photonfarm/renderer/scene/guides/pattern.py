"""The sample points of guides, one low-discrepancy set shifted by another offset in each pixel; kernels' settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.records import F32
from photonfarm.renderer.scene.gbuffer import GRID

FOLLOWED = 8
"""The most mirrors and panes of glass that are followed."""

NO_LIMIT = 1 << 20
"""The edges of a path if the spec sets no limit."""


@dataclass(frozen=True, slots=True)
class GuideSettings:
    """The numbers that a kernel is compiled for."""

    light_samples: int  # of each ray
    followed: int  # the most mirrors and panes
    max_depth: int  # the most edges of a path
    near: float  # distance of the near plane
    glossy: bool  # whether any surface has lobes that are neither diffuse nor followed


SUB_PIXELS = GRID * GRID

STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
"""The steps of the additive recurrence R₃, n · steps modulo 1.

They are the powers of 1 / 1.2207…, the root of x⁴ = x + 1 [Roberts, The unreasonable effectiveness of quasirandom
sequences, 2018].
"""


def pattern_of(light_samples: int) -> F32:
    """The points of a pixel before the shift, (…, 3): first those of each light sample, then those of the BSDF."""
    number = np.arange((light_samples + 1) * SUB_PIXELS)[:, None]
    return (number * np.array(STEPS) % 1).astype(np.float32)


def shift_pattern(pattern: Any, shift: Any, sample: Any) -> list[Any]:
    """The three random numbers of sample number `sample`, for each ray."""
    within = dr.arange(mi.UInt32, dr.width(shift)) % SUB_PIXELS
    place = sample * SUB_PIXELS + within
    u = [dr.gather(mi.Float, column, place) + x for column, x in zip(pattern, shift, strict=True)]
    return [x - dr.floor(x) for x in u]


class PatternSampler:
    """A sampler that returns three given numbers: one to choose a light, and two to choose a point on it."""

    def __init__(self, u: list[Any]) -> None:
        self._u = u

    def next_1d(self) -> Any:
        """The first number, which chooses a light."""
        return self._u[0]

    def next_2d(self) -> Any:
        """The other two numbers, which choose a point on the light."""
        return mi.Point2f(self._u[1], self._u[2])
