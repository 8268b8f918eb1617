"""OBJ with MTL: trimesh reads the geometry; materials become the Mitsuba material that is nearest."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Mesh
from photonfarm.renderer.importing.readers.mtl import Material, put_material, read_materials
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log

CORNERS = 3
"""The fewest corners of a face, and coordinates of a corner."""

_OBJECTS = re.compile(r"^o\s", re.MULTILINE)
_LIBRARIES = re.compile(r"^mtllib\s+(.+?)\s*$", re.MULTILINE)


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file; meshes and changed images are put into the folder `scratch`. Raises SpecError if it cannot be."""
    log(f"reading {path.name}")
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror or error}") from error
    materials = _materials(path, text)
    scene, ids = ImportedScene(), Ids()
    known = {name: ids.make(name, "material") for name in ["", *materials]}
    geometry = _geometry(path, text, materials)
    used = {_material_of(part) for part in geometry.values()} & set(materials)
    for name in ("", *(name for name in materials if name in used)):
        put_material(scene.root, known[name], materials.get(name), scratch, scene.changes)
    for name, part in geometry.items():
        material = _material_of(part)
        made = ids.make(name)
        owner = name.removesuffix(f"_{material}") if material else name
        _put_shape(scene, made, part, known.get(material, known[""]), materials.get(material), owner)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no faces with an area; nothing can be rendered")
    return scene


def _materials(path: Path, text: str) -> dict[str, Material]:
    found: dict[str, Material] = {}
    for line in _LIBRARIES.findall(text):
        file = path.parent / line
        if not file.is_file():
            raise SpecError(f"{path}: material file {line!r} is not there; put it there, or take its mtllib line out")
        found |= read_materials(file)
    return found


def _geometry(path: Path, text: str, materials: dict[str, Material]) -> dict[str, dict[str, Any]]:
    """Meshes by name, one for each object, or else group, and material."""
    from trimesh.exchange.obj import load_obj

    objects = _OBJECTS.search(text) is not None
    stated = "\n".join(f"newmtl {name}\nKd 1 1 1" for name in materials)
    try:
        loaded = load_obj(
            io.StringIO(text), _Library(stated.encode()), split_objects=objects, split_groups=not objects
        )  # fmt: skip
    except (ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
        raise SpecError(f"{path}: is not a readable OBJ file: {error}") from error
    found: dict[str, dict[str, Any]] = loaded.get("geometry", {})
    if not found:
        raise SpecError(f"{path}: has no faces; nothing can be rendered")
    return dict(sorted(found.items()))


class _Library(dict[str, bytes]):
    """The names of all materials, under the name of any file: trimesh asks for the first alone."""

    def __init__(self, materials: bytes) -> None:
        super().__init__()
        self.materials = materials

    def __missing__(self, name: str) -> bytes:
        return self.materials

    def get(self, name: str, default: object = None) -> bytes:  # noqa: ARG002
        """The materials, whatever the name."""
        return self.materials


def _material_of(part: dict[str, Any]) -> str:
    material = getattr(part.get("visual"), "material", None)
    return str(getattr(material, "name", None) or "")


def _put_shape(
    scene: ImportedScene, made: str, part: dict[str, Any], material_id: str, material: Material | None, owner: str
) -> None:
    if not all(np.ndim(part[key]) == 2 and np.shape(part[key])[1] >= CORNERS for key in ("vertices", "faces")):
        return  # points, lines, and what is no surface
    uv, normals = getattr(part.get("visual"), "uv", None), part.get("vertex_normals")
    if uv is not None and len(uv) != len(part["vertices"]):
        uv = None
    mesh = Mesh(
        np.asarray(part["vertices"], np.float64)[:, :3],
        _triangles(np.asarray(part["faces"], np.uint32)),
        None if normals is None else np.asarray(normals, np.float64),
        None if uv is None else np.asarray(uv) * (1, -1) + (0, 1),
    )
    light: Element | None = None
    if material is not None and material.emits:
        light = elements.area_light(material.colour("ke", (0, 0, 0)))
    scene.put_shape(made, mesh, material_id, owner, light, both_sides=True)


def _triangles(polygons: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The triangles (F, 3) of polygons (N, corners), each from its first corner."""
    fans = [polygons[:, [0, corner, corner + 1]] for corner in range(1, polygons.shape[1] - 1)]
    return np.concatenate(fans)
