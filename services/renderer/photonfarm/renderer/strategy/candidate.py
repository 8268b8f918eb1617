"""Candidates for the settings of `bdpt`, which all have the same mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from photonfarm.shared.core.records import F32


@dataclass(frozen=True, slots=True, order=True)
class Candidate:
    """Settings of `bdpt`; all candidates have the same mean."""

    connections: int  # light vertices joined to each of the first two eye vertices
    light_ratio: float  # light paths per eye path; 0: plain path tracing
    guided_light: bool = False  # whether a guide says where light paths start and connections go
    light_samples: int = 1  # of next event estimation at the first eye vertex

    def __str__(self) -> str:
        few = {0: "without connections", 1: "with 1 connection"}
        joined = few.get(self.connections, f"with {self.connections} connections")
        walks = f"light ratio {self.light_ratio:g} {joined}" if self.light_ratio else "plain path tracing"
        samples = f", {self.light_samples} light samples" if self.light_samples > 1 else ""
        return walks + ", guided light" * self.guided_light + samples


PLAIN = Candidate(0, 0.0)
"""Plain path tracing with next event estimation: the baseline of all comparisons."""

DEFAULT = Candidate(1, 1.0)
"""The settings of a spec that states none."""

Render: TypeAlias = Callable[[Candidate, int, int], F32]
"""(candidate, seed, samples per pixel) → one unbiased noisy image (H, W, 3) of one configuration and view."""
