"""An imported scene, in Mitsuba's terms: its meshes and all else that every reader makes, whatever the file was.

Shape letters: V vertices, F faces.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import Changes

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

_NOT_OF_AN_ID = re.compile(r"[\s.:/\\\"'<>&$]+")
"""What Mitsuba or a path gives a meaning of its own."""

ID_LENGTH = 64

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


class Ids:
    """Distinct ids of shapes and materials, made of names that may be anything; those in `root` are taken."""

    def __init__(self, root: Element | None = None) -> None:
        self._taken = {node.get("id", "") for node in ([] if root is None else root.iter())}

    def make(self, name: str, otherwise: str = "shape") -> str:
        """An id like `name`, with a number behind it if the name itself is taken."""
        stem = _NOT_OF_AN_ID.sub("_", name).strip("_")[:ID_LENGTH] or otherwise
        made, number = stem, 1
        while made in self._taken:
            number += 1
            made = f"{stem}_{number}"
        self._taken.add(made)
        return made


@dataclass(slots=True)
class ImportedScene:
    """A scene as Mitsuba 3 reads it, with what the source says of it beyond that."""

    root: Element = field(default_factory=elements.scene)  # materials first, then shapes with ids, and lights
    meshes: dict[str, Mesh] = field(default_factory=dict)  # in world coordinates, of the shapes that name no file yet
    objects: dict[str, str] = field(default_factory=dict)  # the object that a shape id belongs to, where the file says
    changes: Changes = field(default_factory=Changes)
    ids: Ids = field(default_factory=Ids)
    names: dict[str, str] = field(default_factory=dict)  # of properties as the file has them, by Mitsuba's
    up: Vector = (0.0, 1.0, 0.0)
    camera: Vector | None = None  # the position of the source's camera, which is inside the room, most likely
    _backs: set[str] = field(default_factory=set)  # ids of meshes that are written as sheets behind themselves

    def put_shape(
        self,
        made: str,
        mesh: Mesh,
        material: str,
        owner: str,
        light: Element | None = None,
        *,
        both_sides: bool = False,
    ) -> None:
        """Add a mesh with a material id, and an `<emitter>` if it shines, from `both_sides` or from its front alone.

        A mesh without a usable face is left out. Lights are flat, as smooth ones cannot be sampled without bias.
        Mitsuba's shine from the front alone, so a second sheet behind the first shines from the back.
        """
        if light is not None and mesh.normals is not None:
            self.changes.note("lights are flat here: smooth normals of their meshes are left out", made)
        mesh = mesh.usable(made, self.changes, smooth=light is None)
        if not len(mesh.faces):
            return
        shape_ids = [made]
        if light is not None and both_sides and not mesh.encloses():
            shape_ids.append(self.ids.make(f"{made}_back"))
        self._backs.update(shape_ids[1:])
        for shape_id in shape_ids:
            shape = elements.mesh_shape(self.root, shape_id, faceted=mesh.normals is None)
            SubElement(shape, "ref", id=material)
            if light is not None:
                shape.append(elements.copy_element(light))
            self.meshes[shape_id] = mesh
            self.objects[shape_id] = owner

    def write_meshes(self, folder: Path) -> None:
        """Write the meshes into a folder, and let their shapes name the files."""
        for shape in self.root.findall("shape"):
            mesh = self.meshes.get(shape.get("id", ""))
            name = elements.child(shape, "filename")
            if mesh is not None and name is not None:
                mesh = mesh.back() if shape.get("id") in self._backs else mesh
                name.set("value", str(write_ply(mesh, folder / f"{shape.get('id')}.ply")))
