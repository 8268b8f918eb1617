"""The two built-in rooms.

`cornell` is a static box, 2 × 2 × 2 m, with a tall and a short block (after Goral et al., SIGGRAPH 1984). The open side
is at z = 1; the light hangs 5 mm below the ceiling. `room` is a furnished room, 5.2 × 2.6 × 4.2 m, closed, with nine
movable pieces and two ceiling lights.

x runs right, y up, z towards the front; the origin is in the middle of the floor. Floor and ceiling reach 5 cm beyond
the walls, so that groups parked at the corner of the bounding box are outside.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from photonfarm.renderer.scene.rooms import furniture, materials
from photonfarm.renderer.scene.rooms.materials import diffuse, glossy, metal, textured
from photonfarm.renderer.scene.rooms.solids import Point, box, join, mesh, quad, rectangle_light, standing_box

X, Y, Z = 2.6, 2.6, 2.1  # half width, height, half depth
WHITE, RED, GREEN = (0.73, 0.71, 0.68), (0.60, 0.06, 0.05), (0.12, 0.43, 0.10)

OVERHANG = 0.05

UNIT_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)

PLACES: dict[str, tuple[Point, float]] = {
    "table": ((-0.9, 0, 0.45), 0.0),
    "chair-1": ((-1.25, 0, 1.15), np.pi),
    "chair-2": ((-0.50, 0, -0.25), 0.0),
    "sofa": ((1.85, 0, 0.3), -np.pi / 2),
    "shelf": ((-0.9, 0, -1.90), 0.0),
    "lamp": ((2.15, 0, -1.55), 0.0),
    "pedestal": ((-2.1, 0, -1.35), 0.0),
    "mirror": ((0.75, 0, -1.75), -0.25),
    "vase": ((1.55, 0, 1.65), 0.0),
}
"""The place of each piece, and its rotation about y in radians."""

CREAM, TERRACOTTA, TEAL = (0.76, 0.72, 0.64), (0.62, 0.27, 0.17), (0.16, 0.34, 0.36)
OAK, WALNUT = (0.48, 0.30, 0.16), (0.26, 0.14, 0.075)
LAMP_RADIANCE = (8.0, 5.4, 2.8)
LIGHT_RADIANCE, LIGHT_SIZE = (10.8, 9.8, 8.2), (1.6, 0.8)  # large and dim: small ones would dominate squared errors
LIGHT_PLACES = ((-1.2, Y - 0.01, 0.0), (1.2, Y - 0.02, 0.0))  # a centimetre apart, so that they never coincide


def describe_room() -> dict[str, Any]:
    """The shapes by id, for `mi.load_dict`."""
    shapes = {**_walls(), **_decoration(), **_furniture()}
    for i, place in enumerate(LIGHT_PLACES, start=1):
        shapes[f"ceiling-light-{i}"] = rectangle_light(place, LIGHT_SIZE, (0, 1, 0), LIGHT_RADIANCE)
    return shapes


def _walls() -> dict[str, Any]:
    x, z = X + OVERHANG, Z + OVERHANG
    surfaces = {
        "ceiling": (quad((-x, Y, -z), (2 * x, 0, 0), (0, 0, 2 * z)), (0.80, 0.79, 0.76)),
        "wall-back": (quad((-X, 0, -Z), (2 * X, 0, 0), (0, Y, 0)), CREAM),
        "wall-front": (quad((X, 0, Z), (-2 * X, 0, 0), (0, Y, 0)), CREAM),
        "wall-left": (quad((-X, 0, Z), (0, 0, -2 * Z), (0, Y, 0)), TERRACOTTA),
        "wall-right": (quad((X, 0, -Z), (0, 0, 2 * Z), (0, Y, 0)), TEAL),
    }
    walls = {name: mesh(name, solid, diffuse(colour)) for name, (solid, colour) in surfaces.items()}
    floor = quad((-x, 0, z), (2 * x, 0, 0), (0, 0, -2 * z))
    boards = textured(materials.planks((0.50, 0.33, 0.19)), (2, 1))
    return {"floor": mesh("floor", floor, boards, uv=UNIT_UV), **walls}


def _decoration() -> dict[str, Any]:
    t, h = 0.015, 0.09  # skirting board
    skirting = join(
        *(box((2 * X, h, t), (0, h / 2, side * (Z - t / 2))) for side in (-1, 1)),
        *(box((t, h, 2 * Z - 2 * t), (side * (X - t / 2), h / 2, 0)) for side in (-1, 1)),
    )
    door = join(
        box((0.02, 2.05, 0.95), (-X + 0.01, 1.025, 1.2)),
        *(box((0.01, 0.8, 0.62), (-X + 0.025, y, 1.2)) for y in (0.58, 1.50)),
    )
    frame = box((0.03, 0.84, 1.14), (X - 0.015, 1.55, 0.3))
    canvas = quad((X - 0.031, 1.17, -0.23), (0, 0, 1.06), (0, 0.76, 0))
    rug = quad((-2.1, 0.008, 1.45), (2.6, 0, 0), (0, 0, -1.9))
    return {
        "skirting": mesh("skirting", skirting, diffuse((0.75, 0.74, 0.71))),
        "door": mesh("door", door, glossy((0.62, 0.58, 0.50), 0.25)),
        "painting-frame": mesh("painting-frame", frame, diffuse(WALNUT)),
        "painting": mesh("painting", canvas, textured(materials.painting()), uv=UNIT_UV),
        "rug": mesh("rug", rug, textured(materials.rug((0.50, 0.12, 0.10), (0.72, 0.60, 0.40)), (1, 1)), uv=UNIT_UV),
    }


def _furniture() -> dict[str, Any]:
    shapes = {}
    for piece, (parts, looks) in _pieces().items():
        for part, solid in parts.items():
            shape_id = f"{piece}-{part}"
            shapes[shape_id] = mesh(
                shape_id,
                _place(solid, piece),
                looks[part],
                smooth=part in SMOOTH,
                radiance=LAMP_RADIANCE if part == "shade" else None,
            )
    x, _, z = PLACES["pedestal"][0]
    shapes["pedestal-ball"] = {
        "type": "sphere",
        "center": mi.ScalarPoint3f(x, 0.72 + 0.17, z),
        "radius": 0.17,
        "bsdf": materials.glass(),
    }
    return shapes


def _pieces() -> dict[str, tuple[furniture.Parts, dict[str, dict[str, Any]]]]:
    """The parts of each piece, and their materials."""
    chair = {"wood": diffuse(WALNUT), "cushion": diffuse((0.66, 0.46, 0.12))}
    sofa = {"fabric": diffuse((0.33, 0.36, 0.40)), "pillows": diffuse(TERRACOTTA), "feet": metal("Cr", 0.2)}
    books = {"red": (0.45, 0.07, 0.05), "blue": (0.06, 0.14, 0.32), "cream": CREAM}
    shelf = {f"books-{name}": diffuse(colour) for name, colour in books.items()}
    return {
        "table": (furniture.table(), {"wood": diffuse(OAK), "bowl": glossy((0.70, 0.72, 0.74), 0.1)}),
        "chair-1": (furniture.chair(), chair),
        "chair-2": (furniture.chair(), chair),
        "sofa": (furniture.sofa(), sofa),
        "shelf": (furniture.shelf(), {"wood": diffuse((0.66, 0.52, 0.36)), **shelf}),
        "lamp": (furniture.lamp(), {"stand": metal("Au", 0.25), "shade": diffuse((0.5, 0.5, 0.5))}),
        "pedestal": (furniture.pedestal(), {"stone": glossy((0.62, 0.61, 0.58), 0.15)}),
        "mirror": (furniture.standing_mirror(), {"frame": diffuse(WALNUT), "glass": materials.mirror()}),
        "vase": (furniture.vase(), {"copper": metal("Cu", 0.18)}),
    }


SMOOTH = ("bowl", "cushion", "fabric", "pillows", "copper")


def _place(solid: Any, piece: str) -> Any:
    place, angle = PLACES[piece]
    solid.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 1, 0)))
    solid.apply_translation(place)
    return solid


def describe_cornell() -> dict[str, Any]:
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
