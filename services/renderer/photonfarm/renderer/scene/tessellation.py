"""Triangles of Mitsuba's shapes, for the base point cloud; light transport uses the shapes themselves.

Meshes, rectangles and cubes are used unchanged. Spheres, disks and cylinders become fine meshes whose vertices lie
on the surface (128 sections around, 64 from pole to pole): the area is short by at most 0.1 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError

SECTIONS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """One shape's triangles in world coordinates."""

    vertices: NDArray[np.float32]  # (V, 3)
    faces: NDArray[np.uint32]  # (F, 3)


def triangles_of(shape: Any, sections: int = SECTIONS) -> Triangles:
    """The triangles of one shape, with so many `sections` around a round one.

    Raises SpecError for curves, instances, ellipsoids and other unsupported shapes.
    """
    if shape.is_mesh():
        positions = np.array(shape.vertex_positions_buffer(), np.float32)
        faces = np.array(shape.faces_buffer(), np.uint32)
        return Triangles(positions.reshape(-1, 3), faces.reshape(-1, 3))
    make = {"Sphere": _sphere, "Disk": _disk, "Cylinder": _cylinder}.get(shape.class_name())
    if make is None:
        raise SpecError(
            f"shape {shape.id()!r} is a {shape.class_name()}; "
            "only meshes, rectangles, cubes, spheres, disks and cylinders can be used"
        )
    points = make(sections)
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    vertices = points.reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    corners = _grid_faces(*points.shape[:2])
    if np.linalg.det(to_world[:3, :3]) < 0:
        corners = corners[:, ::-1]
    return Triangles(vertices.astype(np.float32), corners)


def _around(sections: int) -> NDArray[np.float64]:
    angle = np.linspace(0, 2 * np.pi, sections + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _sphere(sections: int) -> NDArray[np.float64]:
    """Unit sphere, rows from the lower pole to the upper."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 1)
    circle = _around(sections)
    points = np.empty((len(polar), len(circle), 3))
    points[..., :2] = np.cos(polar)[:, None, None] * circle
    points[..., 2] = np.sin(polar)[:, None]
    return points


def _disk(sections: int) -> NDArray[np.float64]:
    """Unit disk at z = 0, facing +z: rows from the rim to the centre."""
    rim = np.pad(_around(sections), ((0, 0), (0, 1)))
    return np.stack([rim, np.zeros_like(rim)])


def _cylinder(sections: int) -> NDArray[np.float64]:
    """Unit cylinder without caps, z from 0 to 1."""
    rim = np.pad(_around(sections), ((0, 0), (0, 1)))
    return np.stack([rim, rim + np.array([0, 0, 1])])


def _grid_faces(rows: int, columns: int) -> NDArray[np.uint32]:
    """Two triangles per cell of a grid of vertices; those at poles have no area and are never drawn."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint32)
