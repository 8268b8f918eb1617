"""What this integrator accepts of a scene."""

from __future__ import annotations

from typing import Any

UNBOUNDED = 0xFFFFFFFF


def check_scene(scene: Any) -> None:
    """Raise ValueError for scenes with participating media."""
    for shape in scene.shapes():
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            raise ValueError(
                f"bdpt: shape {shape.id()!r} bounds a participating medium; only surfaces are allowed, because "
                f"neither sub-path "
                "samples distances in a medium; remove the medium, or render with 'volpath'"
            )


def depth_limit(max_depth: int) -> int:
    """Path length in edges as an unsigned bound; −1 is unbounded. Raises ValueError below −1."""
    if max_depth < -1:
        raise ValueError(f"bdpt: max_depth is {max_depth}; allowed are -1 (unbounded) and any number of edges from 0")
    return UNBOUNDED if max_depth == -1 else max_depth
