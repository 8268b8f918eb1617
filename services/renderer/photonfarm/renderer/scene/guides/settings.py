"""The settings of the guides' kernels."""

from __future__ import annotations

from dataclasses import dataclass

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
