"""Triangle meshes on their way into PLY files. Shape letters: V vertices, F faces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.changes import Changes

Floats = NDArray[np.float64]

GAP, LEAST_GAP = 1e-4, 1e-5
"""The distance of the two sheets of a light that shines from both sides, as a share of its extent, and the least one,
as a share of its coordinates, which are written in single precision."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in world coordinates, in double precision until they are written."""

    vertices: Floats  # (V, 3)
    faces: NDArray[np.uint32]  # (F, 3)
    normals: Floats | None = None  # (V, 3); None: those of the faces
    uv: Floats | None = None  # (V, 2), v downwards, as Mitsuba has it
    colours: Floats | None = None  # (V, 3), linear reflectance of vertices

    def part(self, faces: NDArray[np.bool_]) -> Mesh:
        """The mesh of some of its faces, a mask (F,)."""
        used, corner = np.unique(self.faces[faces], return_inverse=True)
        return self._of_vertices(used, corner.reshape(-1, 3).astype(np.uint32))

    def _of_vertices(self, used: NDArray[Any], faces: NDArray[np.uint32]) -> Mesh:
        normals, uv, colours = (None if x is None else x[used] for x in (self.normals, self.uv, self.colours))
        return Mesh(self.vertices[used], faces, normals, uv, colours)

    def moved(self, matrix: Floats) -> Mesh:
        """The mesh under an affine map (4, 4); where that mirrors, faces turn so that their fronts stay fronts."""
        linear = matrix[:3, :3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        normals = None if self.normals is None else unit(self.normals @ np.linalg.pinv(linear))
        return replace(self, vertices=self.vertices @ linear.T + matrix[:3, 3], faces=faces, normals=normals)

    def usable(self, what: str, changes: Changes, *, smooth: bool = True) -> Mesh:
        """What of the mesh renders, without normals unless `smooth`; what was wrong with it is said of `what`.

        Faces without an area or with corners that are no numbers are left out. Where a normal is zero or no number,
        its faces get their own.
        """
        across = self._across()
        known = np.asarray(np.isfinite(across).all(axis=1))
        flat = np.asarray(np.linalg.norm(across, axis=1) == 0)
        mesh = self if (known & ~flat).all() else self.part(known & ~flat)
        if not known.all():
            meaning = "faces with corners that are no numbers are missing"
            changes.lose("geometry", "NaN", meaning, f"{what}: {(~known).sum()} of {len(known)}")
        if flat.any():
            changes.note("faces without an area are left out", f"{what}: {flat.sum()} of {len(flat)}")
        if mesh.normals is None or not smooth:
            return replace(mesh, normals=None)
        length = np.linalg.norm(mesh.normals, axis=1)
        bad = ~(np.isfinite(length) & (length > 1e-6))[mesh.faces].all(axis=1)
        if bad.all():
            mesh = replace(mesh, normals=None)
        elif bad.any():
            mesh = mesh._with_own_normals(bad)
        if bad.any():
            meaning = "faces whose normals are zero or no numbers get their own"
            changes.note(meaning, f"{what}: {bad.sum()} of {len(bad)}")
        return mesh

    def _with_own_normals(self, flat: NDArray[np.bool_]) -> Mesh:
        """The mesh with corners of their own, and the face's normal on them, for some faces, a mask (F,)."""
        assert self.normals is not None  # noqa: S101 - the one caller has them
        smooth, own = self.part(~flat), self._of_vertices(self.faces[flat].ravel(), np.zeros((0, 3), np.uint32))
        corners = np.arange(3 * int(flat.sum()), dtype=np.uint32).reshape(-1, 3) + len(smooth.vertices)
        normals = np.repeat(unit(self._across()[flat]), 3, axis=0)

        def joined(a: Floats | None, b: Floats | None) -> Floats | None:
            return None if a is None or b is None else np.concatenate([a, b])

        return Mesh(
            np.concatenate([smooth.vertices, own.vertices]),
            np.concatenate([smooth.faces, corners]),
            joined(smooth.normals, normals),
            joined(smooth.uv, own.uv),
            joined(smooth.colours, own.colours),
        )

    def _across(self) -> Floats:
        """The normals of faces as modelled (F, 3), as long as twice their areas."""
        corners = self.vertices[self.faces]
        with np.errstate(invalid="ignore", over="ignore"):
            made: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return made

    def encloses(self) -> bool:
        """Whether the mesh closes in a volume and faces away from it, so that nobody sees its back."""
        _, vertex = np.unique(self.vertices, axis=0, return_inverse=True)
        corner = vertex.reshape(-1)[self.faces].astype(np.int64)
        edges = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
        key, back = edges[:, 0] * len(self.vertices) + edges[:, 1], edges[:, 1] * len(self.vertices) + edges[:, 0]
        middle = self.vertices.mean(axis=0)
        volume = ((self.vertices[self.faces[:, 0]] - middle) * self._across()).sum()
        return bool(np.array_equal(np.sort(key), np.sort(back)) and volume > 0)

    def back(self) -> Mesh:
        """A sheet that faces the other way, behind this one."""
        away = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(away, self.faces[:, corner], self._across())
        gap = max(GAP * np.linalg.norm(np.ptp(self.vertices, axis=0)), LEAST_GAP * np.abs(self.vertices).max())
        return replace(self, vertices=self.vertices - gap * unit(away), faces=self.faces[:, ::-1])


def unit(vectors: Floats) -> Floats:
    """Vectors (…, 3) of length 1; zero stays zero."""
    made: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
    return made


def of_shape(shape: Any) -> Mesh:
    """The mesh of a shape that Mitsuba has loaded."""
    import mitsuba as mi

    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.array(shape.faces_buffer(), np.uint32).reshape(-1, 3)
    normals, uv, colours = None, None, None
    if shape.has_vertex_normals():
        normals = np.array(shape.vertex_normals_buffer(), np.float64).reshape(-1, 3)
    if shape.has_vertex_texcoords():
        uv = np.array(shape.vertex_texcoords_buffer(), np.float64).reshape(-1, 2)
    if shape.has_attribute("vertex_color"):
        colours = np.array(mi.traverse(shape)["vertex_color"], np.float64).reshape(-1, 3)
    mesh = Mesh(vertices, faces, normals, uv, colours)
    if not _is_turned(shape, mesh):
        return mesh
    return replace(mesh, faces=faces[:, ::-1], normals=None if normals is None else -normals)


def _is_turned(shape: Any, mesh: Mesh) -> bool:
    """Whether Mitsuba has the fronts of a shape on the other side, by `flip_normals` or as it is mirrored."""
    import mitsuba as mi

    across = mesh._across()
    face = int(np.nan_to_num(np.linalg.norm(across, axis=1)).argmax())
    middle, normal = mesh.vertices[mesh.faces[face]].mean(axis=0), unit(across[face])
    origin = middle + 1e-3 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) * normal
    alone = mi.load_dict({"type": "scene", shape.id(): shape})  # another key would rename it
    hit = alone.ray_intersect(mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*(-normal).tolist())))
    return bool(np.array(hit.n, np.float64).ravel() @ normal < 0)


def write_ply(mesh: Mesh, file: Path) -> Path:
    """Write a mesh, as Mitsuba writes it; colours become the attribute `vertex_color`."""
    import mitsuba as mi

    made = mi.Mesh(
        file.stem,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uv is not None,
    )
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mi.Float(mesh.vertices.ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(mesh.faces.ravel())
    if mesh.normals is not None:
        parameters["vertex_normals"] = mi.Float(mesh.normals.ravel().astype(np.float32))
    if mesh.uv is not None:
        parameters["vertex_texcoords"] = mi.Float(mesh.uv.ravel().astype(np.float32))
    parameters.update()
    if mesh.colours is not None:
        made.add_attribute("vertex_color", 3, mesh.colours.ravel().astype(np.float32).tolist())
    file.parent.mkdir(parents=True, exist_ok=True)
    made.write_ply(str(file))
    return file
