"""The numbers that guides are traced with."""

from __future__ import annotations

from dataclasses import dataclass

FOLLOWED = 8
"""Mirrors and panes of glass that are followed at most."""

NO_LIMIT = 1 << 20
"""Edges of a path where the spec sets no limit."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The numbers that a kernel is made for."""

    light_samples: int  # of each ray
    followed: int  # mirrors and panes at most
    max_depth: int  # edges of a path of the images
    near: float  # distance of the near plane
    glossy: bool  # whether any surface has lobes that are neither diffuse nor followed
