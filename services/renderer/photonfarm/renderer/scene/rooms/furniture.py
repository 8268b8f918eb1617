"""Pieces of furniture about the origin, standing on y = 0, facing +z; metres.

A piece is a dictionary of its parts: one shape per material, named by the last part of its id.
"""

from __future__ import annotations

from typing import Any

import trimesh

from photonfarm.renderer.scene.rooms.solids import box, join, lathe, legs, quad, rod, rounded_box, standing_box

Parts = dict[str, Any]
"""Meshes by the name of the part."""


def table() -> Parts:
    """A dining table, 1.5 × 0.8 × 0.75, with a bowl on it."""
    top = box((1.5, 0.045, 0.8), (0, 0.7275, 0))
    apron = box((1.34, 0.07, 0.64), (0, 0.67, 0))
    profile = [(0, 0), (0.07, 0), (0.13, 0.05), (0.165, 0.12), (0.155, 0.12), (0.12, 0.055), (0.06, 0.015), (0, 0.015)]
    bowl = lathe(profile)
    bowl.apply_translation((0, 0.75, 0))
    return {"wood": join(top, apron, *legs(1.4, 0.7, 0.705, 0.06)), "bowl": bowl}


def chair() -> Parts:
    """A chair with a cushion, 0.44 wide and 0.88 high."""
    seat = box((0.44, 0.03, 0.44), (0, 0.435, 0))
    posts = [standing_box((0.035, 0.46, 0.035), (side * 0.2, 0.42, -0.2)) for side in (-1, 1)]
    slats = [box((0.37, 0.06, 0.02), (0, height, -0.2)) for height in (0.58, 0.70, 0.82)]
    frame = join(seat, *posts, *slats, *legs(0.44, 0.44, 0.42, 0.035))
    return {"wood": frame, "cushion": rounded_box((0.40, 0.05, 0.40), (0, 0.475, 0.01), 0.022)}


def sofa() -> Parts:
    """A sofa for two, 1.9 wide, with two pillows."""
    body = join(
        rounded_box((1.9, 0.24, 0.85), (0, 0.26, 0), 0.05),
        rounded_box((1.9, 0.62, 0.22), (0, 0.48, -0.32), 0.08),
        *(rounded_box((0.2, 0.44, 0.85), (side * 0.85, 0.36, 0), 0.07) for side in (-1, 1)),
        *(rounded_box((0.74, 0.16, 0.64), (side * 0.375, 0.45, 0.09), 0.06) for side in (-1, 1)),
    )
    pillows = [
        _leaning(rounded_box((0.42, 0.40, 0.13), (0, 0, 0), 0.06), (side * 0.5, 0.69, -0.11)) for side in (-1, 1)
    ]
    return {"fabric": body, "pillows": join(*pillows), "feet": join(*legs(1.8, 0.75, 0.15, 0.045))}


def shelf() -> Parts:
    """A bookcase, 1.1 × 1.7 × 0.3, with books in three colours."""
    sides = [standing_box((0.03, 1.7, 0.3), (side * 0.535, 0, 0)) for side in (-1, 1)]
    boards = [box((1.04, 0.025, 0.3), (0, height, 0)) for height in (0.06, 0.46, 0.86, 1.26, 1.68)]
    back = box((1.04, 1.66, 0.015), (0, 0.85, -0.14))
    books: dict[str, list[Any]] = {"books-red": [], "books-blue": [], "books-cream": []}
    for row, height in enumerate((0.0725, 0.4725, 0.8725, 1.2725)):
        x = -0.5
        for i in range(9 + row % 2):
            width, tall = 0.035 + 0.012 * ((5 * i + 3 * row) % 4), 0.22 + 0.025 * ((7 * i + row) % 4)
            colour = list(books)[(i * i + row + i // 3) % 3]
            books[colour].append(standing_box((width, tall, 0.2), (x + width / 2, height, -0.02)))
            x += width + 0.004 + (0.18 if (i + row) % 5 == 3 else 0)
    return {"wood": join(*sides, *boards, back), **{name: join(*parts) for name, parts in books.items()}}


def lamp() -> Parts:
    """A floor lamp, 1.6 high; its shade shines."""
    stand = join(rod(0.15, (0, 0, 0), 0.02, 32), rod(0.013, (0, 0.02, 0), 1.33))
    shade = lathe([(0, 1.33), (0.19, 1.33), (0.13, 1.6), (0, 1.6)], 12)
    return {"stand": stand, "shade": shade}


def pedestal() -> Parts:
    """A pedestal for a glass ball (which is a sphere, not a mesh)."""
    return {
        "stone": join(
            standing_box((0.40, 0.06, 0.40), (0, 0, 0)),
            standing_box((0.30, 0.62, 0.30), (0, 0.06, 0)),
            standing_box((0.38, 0.04, 0.38), (0, 0.68, 0)),
        )
    }


def standing_mirror() -> Parts:
    """A standing mirror, 0.8 × 1.75."""
    board = box((0.80, 1.75, 0.03), (0, 0.895, -0.018))
    foot = box((0.70, 0.03, 0.34), (0, 0.015, 0))
    return {"frame": join(board, foot), "glass": quad((-0.35, 0.08, 0.0), (0.70, 0, 0), (0, 1.62, 0))}


def vase() -> Parts:
    """A copper floor vase, 0.75 high."""
    outer = [(0, 0), (0.11, 0), (0.13, 0.05), (0.20, 0.28), (0.19, 0.42), (0.09, 0.60), (0.075, 0.66), (0.12, 0.75)]
    inner = [(0.105, 0.75), (0.06, 0.66), (0.075, 0.59), (0.17, 0.41), (0.18, 0.28), (0.11, 0.06), (0, 0.03)]
    return {"copper": lathe(outer + inner, 48)}


def _leaning(mesh: Any, place: tuple[float, float, float]) -> Any:
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-0.35, (1, 0, 0)))
    mesh.apply_translation(place)
    return mesh
