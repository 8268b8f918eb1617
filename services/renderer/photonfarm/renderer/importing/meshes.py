"""Triangle meshes on their way into PLY files. Shape letters: V vertices, F faces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in world coordinates."""

    vertices: Floats  # (V, 3)
    faces: NDArray[np.uint32]  # (F, 3)
    normals: Floats | None = None  # (V, 3)
    uv: Floats | None = None  # (V, 2), v downwards, as Mitsuba has it

    def part(self, faces: NDArray[np.bool_]) -> Mesh:
        """The mesh of some of its faces, a mask (F,)."""
        used, corner = np.unique(self.faces[faces], return_inverse=True)
        normals = None if self.normals is None else self.normals[used]
        uv = None if self.uv is None else self.uv[used]
        return Mesh(self.vertices[used], corner.reshape(-1, 3).astype(np.uint32), normals, uv)

    def moved(self, matrix: NDArray[np.float64]) -> Mesh:
        """The mesh under an affine map (4, 4); where that mirrors, faces turn so that their fronts stay fronts."""
        linear = matrix[:3, :3]
        vertices = (self.vertices @ linear.T + matrix[:3, 3]).astype(np.float32)
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        return Mesh(vertices, faces, self._moved_normals(linear), self.uv)

    def _moved_normals(self, linear: NDArray[np.float64]) -> Floats | None:
        if self.normals is None:
            return None
        cofactors = np.linalg.pinv(linear).T
        turned = self.normals @ cofactors.T
        return (turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)).astype(np.float32)

    def usable(self) -> Mesh:
        """The mesh without faces that have no area or corners that are no numbers."""
        corners = self.vertices[self.faces].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        good = np.isfinite(corners).all(axis=(1, 2)) & (np.linalg.norm(across, axis=1) > 0)
        return self if good.all() else self.part(good)


def of_shape(shape: Any) -> Mesh:
    """The mesh of a shape that Mitsuba has loaded."""
    vertices = np.array(shape.vertex_positions_buffer(), np.float32).reshape(-1, 3)
    faces = np.array(shape.faces_buffer(), np.uint32).reshape(-1, 3)
    normals, uv = None, None
    if shape.has_vertex_normals():
        normals = np.array(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
    if shape.has_vertex_texcoords():
        uv = np.array(shape.vertex_texcoords_buffer(), np.float32).reshape(-1, 2)
    return Mesh(vertices, faces, normals, uv)


def write_ply(mesh: Mesh, file: Path) -> Path:
    """Write a mesh, as Mitsuba writes it."""
    import mitsuba as mi

    made = mi.Mesh(
        file.stem,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uv is not None,
    )
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mi.Float(mesh.vertices.ravel())
    parameters["faces"] = mi.UInt32(mesh.faces.ravel())
    if mesh.normals is not None:
        parameters["vertex_normals"] = mi.Float(mesh.normals.ravel())
    if mesh.uv is not None:
        parameters["vertex_texcoords"] = mi.Float(mesh.uv.ravel())
    parameters.update()
    file.parent.mkdir(parents=True, exist_ok=True)
    made.write_ply(str(file))
    return file
