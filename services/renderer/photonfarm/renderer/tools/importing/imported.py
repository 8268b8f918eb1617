"""An imported scene, in Mitsuba's terms: what every reader makes, whatever the file was."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import Changes
from photonfarm.renderer.tools.importing.meshes import Mesh, write_ply

Vector = tuple[float, float, float]

_NOT_OF_AN_ID = re.compile(r"[\s.:/\\\"'<>&$]+")
"""What Mitsuba or a path gives a meaning of its own."""

ID_LENGTH = 64


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
