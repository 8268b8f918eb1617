"""The room `cornell`: a static box, 2 × 2 × 2 m, with a tall and a short block (after Goral et al., SIGGRAPH 1984).

x runs right, y up, and the open side is at z = 1; the light hangs 5 mm below the ceiling.
"""

from __future__ import annotations

from typing import Any

import trimesh

from photonfarm.renderer.scene.rooms.materials import diffuse
from photonfarm.renderer.scene.rooms.solids import mesh, quad, rectangle_light, standing_box

WHITE, RED, GREEN = (0.73, 0.71, 0.68), (0.60, 0.06, 0.05), (0.12, 0.43, 0.10)


def describe() -> dict[str, Any]:
    """The shapes by id, for `mi.load_dict`."""
    walls = {
        "floor": (quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)), WHITE),
        "ceiling": (quad((-1, 2, -1), (2, 0, 0), (0, 0, 2)), WHITE),
        "back-wall": (quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)), WHITE),
        "left-wall": (quad((-1, 0, 1), (0, 0, -2), (0, 2, 0)), RED),
        "right-wall": (quad((1, 0, -1), (0, 0, 2), (0, 2, 0)), GREEN),
        "tall-block": (_block((0.6, 1.2, 0.6), (-0.34, 0, -0.30), 0.30), WHITE),
        "short-block": (_block((0.6, 0.6, 0.6), (0.34, 0, 0.36), -0.29), WHITE),
    }
    shapes = {name: mesh(name, solid, diffuse(colour)) for name, (solid, colour) in walls.items()}
    light = rectangle_light((0, 1.995, 0), (0.5, 0.5), (0, 1, 0), (17.0, 12.0, 5.5))
    return {**shapes, "ceiling-light": light}


def _block(size: tuple[float, float, float], foot: tuple[float, float, float], angle: float) -> Any:
    block = standing_box(size, (0, 0, 0))
    block.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 1, 0)))
    block.apply_translation(foot)
    return block
