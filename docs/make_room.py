"""A furnished room as a glTF file, for the tutorial: python make_room.py my-room.glb.

Lengths are metres, y is up, and the origin is in the middle of the floor.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import trimesh
from trimesh.creation import box, capsule, cylinder, icosphere
from trimesh.visual.material import PBRMaterial

Vector = Sequence[float]

WIDTH, HEIGHT, DEPTH = 5.0, 2.6, 4.0
OAK, WHITE, BLACK = (0.5, 0.32, 0.16), (0.85, 0.85, 0.85), (0.0, 0.0, 0.0)


def block(size: Vector, at: Vector) -> trimesh.Trimesh:
    """A block of a size around a point."""
    return box(size).apply_translation(at)


def upright(mesh: trimesh.Trimesh, at: Vector) -> trimesh.Trimesh:
    """What trimesh makes along z, along y and around a point."""
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))).apply_translation(at)


def legs(width: float, height: float, depth: float, thickness: float) -> list[trimesh.Trimesh]:
    """Four legs at the corners of a rectangle around the origin."""
    x, z = (width - thickness) / 2, (depth - thickness) / 2
    return [block((thickness, height, thickness), (i * x, height / 2, k * z)) for i in (-1, 1) for k in (-1, 1)]


def add(
    scene: trimesh.Scene,
    name: str,
    parts: Sequence[trimesh.Trimesh],
    at: Vector,
    colour: Vector,
    *,
    roughness: float = 0.7,
    light: Vector | None = None,
) -> None:
    """Add one object of one material to a scene; `light` makes it emit."""
    mesh = trimesh.util.concatenate(parts).apply_translation(at)
    material = PBRMaterial(
        name=name,
        baseColorFactor=(*colour, 1.0),
        roughnessFactor=roughness,
        metallicFactor=0.0,
        emissiveFactor=light,
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(mesh, node_name=name, geom_name=name)


def room() -> trimesh.Scene:
    """The room with its furniture and two lights."""
    scene = trimesh.Scene()
    long, short = (WIDTH, HEIGHT, 0.1), (0.1, HEIGHT, DEPTH)
    add(scene, "floor", [box((WIDTH, 0.1, DEPTH))], (0, -0.05, 0), (0.45, 0.3, 0.18), roughness=0.4)
    add(scene, "ceiling", [box((WIDTH, 0.1, DEPTH))], (0, HEIGHT + 0.05, 0), WHITE)
    add(scene, "wall-west", [box(short)], (-WIDTH / 2 - 0.05, HEIGHT / 2, 0), (0.7, 0.25, 0.15))
    add(scene, "wall-east", [box(short)], (WIDTH / 2 + 0.05, HEIGHT / 2, 0), (0.2, 0.4, 0.55))
    add(scene, "wall-north", [box(long)], (0, HEIGHT / 2, -DEPTH / 2 - 0.05), (0.8, 0.76, 0.66))
    add(scene, "wall-south", [box(long)], (0, HEIGHT / 2, DEPTH / 2 + 0.05), (0.8, 0.76, 0.66))

    top = block((1.4, 0.05, 0.8), (0, 0.725, 0))
    add(scene, "table", [top, *legs(1.4, 0.7, 0.8, 0.07)], (0.3, 0, 0), OAK, roughness=0.3)
    sofa = [block((1.8, 0.4, 0.8), (0, 0.2, 0)), block((1.8, 0.45, 0.2), (0, 0.6, -0.3))]
    add(scene, "sofa", sofa, (-0.8, 0, -1.5), (0.15, 0.35, 0.3))
    for number, x in enumerate((-0.1, 0.8)):
        stool = [upright(cylinder(0.2, 0.06), (0, 0.45, 0)), *legs(0.28, 0.42, 0.28, 0.04)]
        add(scene, f"stool-{number}", stool, (x, 0, 0.8), (0.75, 0.55, 0.2))
    add(scene, "vase", [upright(capsule(0.35, 0.14), (0, 0.315, 0))], (1.6, 0, -1.2), (0.15, 0.25, 0.6), roughness=0.15)
    add(scene, "ball", [icosphere(3, 0.25)], (-1.7, 0.25, 1.0), (0.85, 0.5, 0.1), roughness=0.3)

    panel = trimesh.Trimesh([(-0.5, 0, -0.3), (0.5, 0, -0.3), (0.5, 0, 0.3), (-0.5, 0, 0.3)], [(0, 1, 2), (0, 2, 3)])
    add(scene, "panel", [panel], (0, HEIGHT - 0.01, 0), BLACK, light=(1.0, 0.95, 0.85))  # faces down
    add(scene, "lamp-foot", [upright(cylinder(0.03, 1.5), (0, 0.75, 0))], (-2.0, 0, -0.6), BLACK)
    add(scene, "lamp", [icosphere(3, 0.16)], (-2.0, 1.6, -0.6), BLACK, light=(1.0, 0.6, 0.3))
    return scene


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("name the file to write: python make_room.py my-room.glb")
    room().export(sys.argv[1])
