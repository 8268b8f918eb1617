"""Candidates for the settings of `bdpt`, which all have the same mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from photonfarm.shared.core.records import F32


@dataclass(frozen=True, slots=True, order=True)
class Candidate:
    """Settings of `bdpt`; all candidates have the same mean."""

    connections: int  # light vertices joined to each eye vertex
    light_ratio: float  # light paths per eye path; 0: plain path tracing
    guided: bool = False  # whether light paths start where views see them

    def __str__(self) -> str:
        if not self.light_ratio:
            return "plain path tracing"
        few = {0: "without connections", 1: "with 1 connection"}
        joined = few.get(self.connections, f"with {self.connections} connections")
        return f"light ratio {self.light_ratio:g} {joined}" + ", guided" * self.guided


PLAIN = Candidate(0, 0.0)
"""Plain path tracing with next event estimation: the baseline of all comparisons."""

DEFAULT = Candidate(1, 1.0)
"""The settings of a spec that states none."""

Render: TypeAlias = Callable[[Candidate, int, int], F32]
"""(candidate, seed, samples per pixel) → one unbiased noisy image (H, W, 3) of one configuration and view."""
