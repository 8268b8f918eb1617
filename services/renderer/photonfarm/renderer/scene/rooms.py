"""The two built-in rooms, made in code: no files, and nothing to download.

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

from photonfarm.renderer.scene import solids
from photonfarm.renderer.scene.solids import (
    Point,
    box,
    diffuse,
    glossy,
    join,
    lathe,
    legs,
    mesh,
    metal,
    quad,
    rectangle_light,
    rod,
    rounded_box,
    standing_box,
    textured,
)

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


def describe(name: str) -> dict[str, Any]:
    """The shapes of a built-in room by id, for `mi.load_dict`."""
    return _describe_cornell() if name == "cornell" else _describe_room()


def _describe_room() -> dict[str, Any]:
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
    boards = textured(solids.planks((0.50, 0.33, 0.19)), (2, 1))
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
        "painting": mesh("painting", canvas, textured(solids.painting()), uv=UNIT_UV),
        "rug": mesh("rug", rug, textured(solids.rug((0.50, 0.12, 0.10), (0.72, 0.60, 0.40)), (1, 1)), uv=UNIT_UV),
    }


def _furniture() -> dict[str, Any]:
    shapes = {}
    pieces = zip(PLACES, (table, chair, chair, sofa, shelf, lamp, pedestal, standing_mirror, vase), strict=True)
    for piece, make in pieces:
        place, angle = PLACES[piece]
        for part, (solid, look) in make().items():
            shape_id, radiance = f"{piece}-{part}", LAMP_RADIANCE if part == "shade" else None
            solid = _turn(solid, angle, place)
            shapes[shape_id] = mesh(shape_id, solid, look, smooth=part in SMOOTH, radiance=radiance)
    x, _, z = PLACES["pedestal"][0]
    ball = {"type": "sphere", "center": mi.ScalarPoint3f(x, 0.72 + 0.17, z), "radius": 0.17, "bsdf": solids.glass()}
    return {**shapes, "pedestal-ball": ball}


SMOOTH = ("bowl", "cushion", "fabric", "pillows", "copper")


def _turn(solid: Any, angle: float, place: Point, axis: Point = (0, 1, 0)) -> Any:
    """A solid turned about an axis and then moved, in place."""
    solid.apply_transform(trimesh.transformations.rotation_matrix(angle, axis))
    solid.apply_translation(place)
    return solid


def _describe_cornell() -> dict[str, Any]:
    walls = {
        "floor": (quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)), WHITE),
        "ceiling": (quad((-1, 2, -1), (2, 0, 0), (0, 0, 2)), WHITE),
        "back-wall": (quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)), WHITE),
        "left-wall": (quad((-1, 0, 1), (0, 0, -2), (0, 2, 0)), RED),
        "right-wall": (quad((1, 0, -1), (0, 0, 2), (0, 2, 0)), GREEN),
        "tall-block": (_turn(standing_box((0.6, 1.2, 0.6), (0, 0, 0)), 0.30, (-0.34, 0, -0.30)), WHITE),
        "short-block": (_turn(standing_box((0.6, 0.6, 0.6), (0, 0, 0)), -0.29, (0.34, 0, 0.36)), WHITE),
    }
    shapes = {name: mesh(name, solid, diffuse(colour)) for name, (solid, colour) in walls.items()}
    light = rectangle_light((0, 1.995, 0), (0.5, 0.5), (0, 1, 0), (17.0, 12.0, 5.5))
    return {**shapes, "ceiling-light": light}


# ------------------------------------------------ Pieces of furniture ------------------------------------------------
# About the origin, standing on y = 0, facing +z.

Parts = dict[str, tuple[Any, dict[str, Any]]]
"""The parts of a piece, one shape each: meshes and their materials, by the last part of the shape's id."""


def table() -> Parts:
    """A dining table, 1.5 × 0.8 × 0.75, with a bowl on it."""
    top = box((1.5, 0.045, 0.8), (0, 0.7275, 0))
    apron = box((1.34, 0.07, 0.64), (0, 0.67, 0))
    profile = [(0, 0), (0.07, 0), (0.13, 0.05), (0.165, 0.12), (0.155, 0.12), (0.12, 0.055), (0.06, 0.015), (0, 0.015)]
    bowl = lathe(profile)
    bowl.apply_translation((0, 0.75, 0))
    wood = join(top, apron, *legs(1.4, 0.7, 0.705, 0.06))
    return {"wood": (wood, diffuse(OAK)), "bowl": (bowl, glossy((0.70, 0.72, 0.74), 0.1))}


def chair() -> Parts:
    """A chair with a cushion, 0.44 wide and 0.88 high."""
    seat = box((0.44, 0.03, 0.44), (0, 0.435, 0))
    posts = [standing_box((0.035, 0.46, 0.035), (side * 0.2, 0.42, -0.2)) for side in (-1, 1)]
    slats = [box((0.37, 0.06, 0.02), (0, height, -0.2)) for height in (0.58, 0.70, 0.82)]
    frame = join(seat, *posts, *slats, *legs(0.44, 0.44, 0.42, 0.035))
    cushion = rounded_box((0.40, 0.05, 0.40), (0, 0.475, 0.01), 0.022)
    return {"wood": (frame, diffuse(WALNUT)), "cushion": (cushion, diffuse((0.66, 0.46, 0.12)))}


def sofa() -> Parts:
    """A sofa for two, 1.9 wide, with two pillows."""
    body = join(
        rounded_box((1.9, 0.24, 0.85), (0, 0.26, 0), 0.05),
        rounded_box((1.9, 0.62, 0.22), (0, 0.48, -0.32), 0.08),
        *(rounded_box((0.2, 0.44, 0.85), (side * 0.85, 0.36, 0), 0.07) for side in (-1, 1)),
        *(rounded_box((0.74, 0.16, 0.64), (side * 0.375, 0.45, 0.09), 0.06) for side in (-1, 1)),
    )
    pillows = [
        _turn(rounded_box((0.42, 0.40, 0.13), (0, 0, 0), 0.06), -0.35, (side * 0.5, 0.69, -0.11), axis=(1, 0, 0))
        for side in (-1, 1)
    ]
    return {
        "fabric": (body, diffuse((0.33, 0.36, 0.40))),
        "pillows": (join(*pillows), diffuse(TERRACOTTA)),
        "feet": (join(*legs(1.8, 0.75, 0.15, 0.045)), metal("Cr", 0.2)),
    }


def shelf() -> Parts:
    """A bookcase, 1.1 × 1.7 × 0.3, with books in three colours."""
    sides = [standing_box((0.03, 1.7, 0.3), (side * 0.535, 0, 0)) for side in (-1, 1)]
    boards = [box((1.04, 0.025, 0.3), (0, height, 0)) for height in (0.06, 0.46, 0.86, 1.26, 1.68)]
    back = box((1.04, 1.66, 0.015), (0, 0.85, -0.14))
    colours = {"books-red": (0.45, 0.07, 0.05), "books-blue": (0.06, 0.14, 0.32), "books-cream": CREAM}
    books: dict[str, list[Any]] = {name: [] for name in colours}
    for row, height in enumerate((0.0725, 0.4725, 0.8725, 1.2725)):
        x = -0.5
        for i in range(9 + row % 2):
            width, tall = 0.035 + 0.012 * ((5 * i + 3 * row) % 4), 0.22 + 0.025 * ((7 * i + row) % 4)
            colour = list(books)[(i * i + row + i // 3) % 3]
            books[colour].append(standing_box((width, tall, 0.2), (x + width / 2, height, -0.02)))
            x += width + 0.004 + (0.18 if (i + row) % 5 == 3 else 0)
    wood = join(*sides, *boards, back), diffuse((0.66, 0.52, 0.36))
    return {"wood": wood, **{name: (join(*books[name]), diffuse(colour)) for name, colour in colours.items()}}


def lamp() -> Parts:
    """A floor lamp, 1.6 high; its shade shines."""
    stand = join(rod(0.15, (0, 0, 0), 0.02, 32), rod(0.013, (0, 0.02, 0), 1.33))
    shade = lathe([(0, 1.33), (0.19, 1.33), (0.13, 1.6), (0, 1.6)], 12)
    return {"stand": (stand, metal("Au", 0.25)), "shade": (shade, diffuse((0.5, 0.5, 0.5)))}


def pedestal() -> Parts:
    """A pedestal for a glass ball (which is a sphere, not a mesh)."""
    stones = (((0.40, 0.06, 0.40), 0.0), ((0.30, 0.62, 0.30), 0.06), ((0.38, 0.04, 0.38), 0.68))
    stone = join(*(standing_box(size, (0, height, 0)) for size, height in stones))
    return {"stone": (stone, glossy((0.62, 0.61, 0.58), 0.15))}


def standing_mirror() -> Parts:
    """A standing mirror, 0.8 × 1.75."""
    board = box((0.80, 1.75, 0.03), (0, 0.895, -0.018))
    foot = box((0.70, 0.03, 0.34), (0, 0.015, 0))
    glass = quad((-0.35, 0.08, 0.0), (0.70, 0, 0), (0, 1.62, 0))
    return {"frame": (join(board, foot), diffuse(WALNUT)), "glass": (glass, solids.mirror())}


def vase() -> Parts:
    """A copper floor vase, 0.75 high."""
    outer = [(0, 0), (0.11, 0), (0.13, 0.05), (0.20, 0.28), (0.19, 0.42), (0.09, 0.60), (0.075, 0.66), (0.12, 0.75)]
    inner = [(0.105, 0.75), (0.06, 0.66), (0.075, 0.59), (0.17, 0.41), (0.18, 0.28), (0.11, 0.06), (0, 0.03)]
    return {"copper": (lathe(outer + inner, 48), metal("Cu", 0.18))}
