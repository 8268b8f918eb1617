"""Triangle meshes on their way into PLY files. Shape letters: V vertices, F faces."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from photonfarm.renderer.tools.importing.changes import Changes

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
    attributes: dict[str, Floats] = field(default_factory=dict)
    """(V or F, …) by Mitsuba's names, such as `vertex_color` and `face_tint`: colours are linear reflectances."""

    def part(self, faces: NDArray[np.bool_]) -> Mesh:
        """The mesh of some of its faces, a mask (F,)."""
        used, corner = np.unique(self.faces[faces], return_inverse=True)
        normals, uv = (None if values is None else values[used] for values in (self.normals, self.uv))
        attributes = {name: of[faces if name.startswith("face_") else used] for name, of in self.attributes.items()}
        return Mesh(self.vertices[used], corner.reshape(-1, 3).astype(np.uint32), normals, uv, attributes)

    def transform(self, matrix: Floats) -> Mesh:
        """The mesh under an affine map (4, 4); where that mirrors, faces turn so that their fronts stay fronts."""
        linear = matrix[:3, :3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        normals = None if self.normals is None else unit(self.normals @ np.linalg.pinv(linear))
        return replace(self, vertices=self.vertices @ linear.T + matrix[:3, 3], faces=faces, normals=normals)

    def usable(self, what: str, changes: Changes, *, smooth: bool = True) -> Mesh:
        """What of the mesh renders, without normals unless `smooth`; what was wrong with it is said of `what`.

        Faces without an area or with corners that are no numbers are left out. Normals that are zero or no numbers
        become those of the faces around them.
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
        usable = np.isfinite(length) & (length > 1e-6)
        bad = ~usable[mesh.faces].all(axis=1)
        if bad.any():
            meaning = "faces whose normals are zero or no numbers get their own"
            changes.note(meaning, f"{what}: {bad.sum()} of {len(bad)}")
            normals = np.where(usable[:, None], mesh.normals, mesh._around())
            mesh = replace(mesh, normals=None if bad.all() else normals)
        return mesh

    def _around(self) -> Floats:
        """The mean normals of the faces around each vertex (V, 3), by their areas."""
        made = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(made, self.faces[:, corner], self._across())
        return unit(made)

    def _across(self) -> Floats:
        """The normals of faces as modelled (F, 3), as long as twice their areas."""
        corners = self.vertices[self.faces]
        with np.errstate(invalid="ignore", over="ignore"):
            made: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return made

    def encloses(self) -> bool:
        """Whether the mesh closes in a volume and faces away from it, so that nobody sees its back."""
        return bool(trimesh.Trimesh(self.vertices, self.faces).is_volume)

    def back(self) -> Mesh:
        """A sheet that faces the other way, behind this one."""
        gap = max(GAP * np.linalg.norm(np.ptp(self.vertices, axis=0)), LEAST_GAP * np.abs(self.vertices).max())
        return replace(self, vertices=self.vertices - gap * self._around(), faces=self.faces[:, ::-1])


def unit(vectors: Floats) -> Floats:
    """Vectors (…, 3) of length 1; zero stays zero."""
    made: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
    return made


def read_mesh(shape: Any) -> Mesh:
    """The mesh of a shape that Mitsuba has loaded."""
    import mitsuba as mi

    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.array(shape.faces_buffer(), np.uint32).reshape(-1, 3)
    normals, uv = None, None
    if shape.has_vertex_normals():
        normals = np.array(shape.vertex_normals_buffer(), np.float64).reshape(-1, 3)
    if shape.has_vertex_texcoords():
        uv = np.array(shape.vertex_texcoords_buffer(), np.float64).reshape(-1, 2)
    if shape.has_flipped_normals():
        faces, normals = faces[:, ::-1], None if normals is None else -normals
    attributes = {}
    for name, values in mi.traverse(shape):
        count = {"vertex": len(vertices), "face": len(faces)}.get(name.split("_")[0])
        if count and shape.has_attribute(name):
            attributes[name] = np.array(values, np.float64).reshape(count, -1)
    return Mesh(vertices, faces, normals, uv, attributes)


def write_ply(mesh: Mesh, file: Path) -> Path:
    """Write a mesh, as Mitsuba writes it."""
    import mitsuba as mi

    has = {"has_vertex_normals": mesh.normals is not None, "has_vertex_texcoords": mesh.uv is not None}
    made = mi.Mesh(file.stem, len(mesh.vertices), len(mesh.faces), **has)
    parameters = mi.traverse(made)
    values = {"vertex_positions": mesh.vertices, "vertex_normals": mesh.normals, "vertex_texcoords": mesh.uv}
    for name, numbers in values.items():
        if numbers is not None:
            parameters[name] = mi.Float(numbers.ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(mesh.faces.ravel())
    parameters.update()
    for name, numbers in mesh.attributes.items():
        made.add_attribute(name, numbers.shape[1], numbers.ravel().astype(np.float32).tolist())
    file.parent.mkdir(parents=True, exist_ok=True)
    made.write_ply(str(file))
    return file
