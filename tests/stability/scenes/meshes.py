"""Meshes made by hand, as shapes that a scene's dictionary takes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt


def mesh(
    name: str, positions: npt.NDArray[Any], faces: npt.NDArray[Any], *, smooth: Any = None, **children: Any
) -> Any:
    """A mesh of positions [V, 3] and faces [F, 3]; ``smooth`` are vertex normals [V, 3]; children as dictionaries."""
    properties = mi.Properties()
    for key, child in children.items():
        properties[key] = mi.load_dict(child)
    shape = mi.Mesh(name, len(positions), len(faces), has_vertex_normals=smooth is not None, props=properties)
    values = mi.traverse(shape)
    values["vertex_positions"] = np.ascontiguousarray(positions, np.float32).ravel()
    values["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
    if smooth is not None:
        values["vertex_normals"] = np.ascontiguousarray(smooth, np.float32).ravel()
    values.update()
    return shape


def grid(name: str, cells: int, **children: Any) -> Any:
    """A mesh of 2·cells² triangles of unequal sizes that face down from under the ceiling of `room`."""
    at = np.sort(np.concatenate([[-0.3, 0.3], np.random.default_rng(5).uniform(-0.3, 0.3, cells - 1)]))
    y, x = np.meshgrid(at, at, indexing="ij")
    positions = np.stack([x, y, np.full_like(x, 1.95)], axis=-1).reshape(-1, 3)
    row, column = (part.ravel() for part in np.divmod(np.arange(cells * cells), cells))
    corner = row * (cells + 1) + column
    lower = np.stack([corner, corner + cells + 1, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + cells + 1, corner + cells + 2], axis=1)
    return mesh(name, positions, np.concatenate([lower, upper]), **children)


def octahedron(name: str, centre: list[float], radius: float, **children: Any) -> Any:
    """An octahedron whose vertex normals are those of a sphere."""
    n = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float32)
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]
    return mesh(name, n * radius + np.asarray(centre, np.float32), np.array(faces), smooth=n, **children)


def smooth_ball(name: str, centre: list[float], radius: float, **children: Any) -> Any:
    """A sphere of 80 triangles with smooth normals: shading and geometry disagree at every edge."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    n = np.asarray(ball.vertices)
    return mesh(name, n * radius + np.asarray(centre), np.asarray(ball.faces), smooth=n, **children)
