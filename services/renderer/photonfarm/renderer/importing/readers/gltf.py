"""glTF and GLB: the nodes of a scene as shapes, by the names of nodes, with lights and the camera. Metres, y up."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Mesh
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node
from photonfarm.renderer.importing.readers.gltf_materials import Materials
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log

Matrix = NDArray[np.float64]

_LISTS, _STRIPS, _FANS = 4, 5, 6
"""The modes of primitives that are triangles."""

OBJECT_SHARE = 0.34
"""A node is an object as a whole up to this share of all meshes; above, it is a folder of objects."""

_NOT_CARRIED = {"animations": "animations", "skins": "skins (meshes stand as modelled)"}

_READ = ("KHR_lights_punctual", "KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp")
"""The extensions that are carried over, beside those of materials, each of which says what it loses."""


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file; meshes and images are put into the folder `scratch`. Raises SpecError for what cannot be read."""
    file = GltfFile(path)
    scene = ImportedScene()
    ids = Ids()
    reader = _Reader(file, scene, scratch, Materials(file, scene.root, scratch, scene.changes, ids), log, ids)
    try:
        reader.read()
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError) as error:
        if isinstance(error, SpecError):
            raise
        raise SpecError(f"{path}: is not valid glTF: {type(error).__name__}: {error}") from error
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: its scene has no triangles; nothing can be rendered")
    return scene


@dataclass(slots=True)
class _Reader:
    file: GltfFile
    scene: ImportedScene
    scratch: Path
    materials: Materials
    log: Log
    ids: Ids
    left_out: dict[str, int] = field(default_factory=dict)  # what is not carried over, and how often

    def read(self) -> None:
        """Read all nodes of the file's scene."""
        nodes = self.file.all("nodes")
        self.log(f"reading {len(nodes)} nodes and {len(self.file.all('meshes'))} meshes of {self.file.path.name}")
        meshes = max(1, sum("mesh" in node for node in nodes))
        for number in self._roots():
            self._visit(number, np.eye(4), "", meshes)
        for key, name in _NOT_CARRIED.items():
            if self.file.all(key):
                self.left_out[name] = len(self.file.all(key))
        for extension in self.file.document.get("extensionsUsed", ()):
            if extension not in _READ and not extension.startswith("KHR_materials"):
                self.left_out[extension] = 1
        if self.left_out:
            listed = ", ".join(f"{name} ({n})" if n > 1 else name for name, n in self.left_out.items())
            self.scene.changes.note(f"not carried over: {listed}")

    def _roots(self) -> list[int]:
        scenes = self.file.all("scenes")
        if scenes:
            return list(scenes[self.file.document.get("scene", 0)].get("nodes", ()))
        below = {child for node in self.file.all("nodes") for child in node.get("children", ())}
        return [number for number in range(len(self.file.all("nodes"))) if number not in below]

    def _visit(self, number: int, above: Matrix, owner: str, meshes: int) -> None:
        node = self.file.all("nodes")[number]
        matrix = above @ _matrix(node)
        name = node.get("name") or f"node_{number}"
        if not owner and self._meshes_below(number) <= max(1.0, OBJECT_SHARE * meshes):
            owner = name
        if "mesh" in node:
            self._put_mesh(node["mesh"], name, matrix, owner or name)
        if "camera" in node and self.scene.camera is None:
            x, y, z = matrix[:3, 3]
            self.scene.camera = (float(x), float(y), float(z))
        light = node.get("extensions", {}).get("KHR_lights_punctual")
        if light is not None:
            self._put_light(light["light"], matrix)
        for child in node.get("children", ()):
            self._visit(child, matrix, owner, meshes)

    def _meshes_below(self, number: int) -> int:
        node = self.file.all("nodes")[number]
        return ("mesh" in node) + sum(map(self._meshes_below, node.get("children", ())))

    # ------------------------------------------------------------------------------------------------------ meshes

    def _put_mesh(self, number: int, name: str, matrix: Matrix, owner: str) -> None:
        primitives = self.file.all("meshes")[number]["primitives"]
        for place, primitive in enumerate(primitives):
            if primitive.get("mode", _LISTS) not in (_LISTS, _STRIPS, _FANS):
                self._lose("points and lines")
                continue
            if "targets" in primitive:
                self._lose("morph targets")
            if "COLOR_0" in primitive["attributes"]:
                self._lose("colours of vertices")
            mesh = self._mesh(primitive).moved(matrix)
            self._put_shape(mesh, f"{name}_{place}" if len(primitives) > 1 else name, primitive, owner)

    def _put_shape(self, mesh: Mesh, name: str, primitive: Node, owner: str) -> None:
        material = primitive.get("material")
        both = bool(self.file.all("materials")[material].get("doubleSided")) if material is not None else False
        light, made = self.materials.light(material), self.ids.make(name)
        self.scene.put_shape(made, mesh, self.materials.material_id(material), owner, light, both_sides=both)

    def _mesh(self, primitive: Node) -> Mesh:
        attributes = primitive["attributes"]
        vertices = self.file.array(attributes["POSITION"]).astype(np.float64)
        order = np.arange(len(vertices)) if "indices" not in primitive else self.file.array(primitive["indices"])[:, 0]
        if order.size and order.max() >= len(vertices):
            raise SpecError(f"{self.file.path}: a mesh names vertex {order.max()}, and has {len(vertices)}")
        uv_name = f"TEXCOORD_{self.materials.uv_set(primitive.get('material'))}"
        normals = self.file.array(attributes["NORMAL"]) if "NORMAL" in attributes else None
        uv = self.file.array(attributes[uv_name]) if uv_name in attributes else None
        return Mesh(
            vertices,
            _triangles(order.astype(np.uint32), primitive.get("mode", _LISTS)),
            None if normals is None else normals.astype(np.float64),
            None if uv is None else uv.astype(np.float64),
        )

    def _lose(self, what: str) -> None:
        self.left_out[what] = self.left_out.get(what, 0) + 1

    # ------------------------------------------------------------------------------------------------------ lights

    def _put_light(self, number: int, matrix: Matrix) -> None:
        """Candela and lux are taken as radiometric units, as emissive strength is, so that all lights agree."""
        light = self.file.document["extensions"]["KHR_lights_punctual"]["lights"][number]
        kinds = {"point": "point", "spot": "spot", "directional": "directional"}
        kind = kinds[light["type"]]
        emitter = SubElement(self.scene.root, "emitter", type=kind, id=self.ids.make(light.get("name", kind)))
        colour = [light.get("intensity", 1.0) * part for part in light.get("color", (1, 1, 1))]
        elements.put_value(emitter, "irradiance" if kind == "directional" else "intensity", colour)
        if kind == "point":
            _put_point(emitter, matrix)
            return
        facing = np.diag([-1.0, 1.0, -1.0, 1.0])  # glTF's lights shine along −z, Mitsuba's along +z
        elements.put_matrix(emitter, "to_world", (_rigid(matrix) @ facing).tolist())
        if kind == "spot":
            cone = light.get("spot", {})
            outer = np.degrees(cone.get("outerConeAngle", np.pi / 4))
            elements.put_value(emitter, "cutoff_angle", float(outer))
            inner = min(np.degrees(cone.get("innerConeAngle", 0.0)), 0.999 * outer)
            elements.put_value(emitter, "beam_width", float(inner))


def _put_point(emitter: Element, matrix: Matrix) -> None:
    x, y, z = (f"{value:.7g}" for value in matrix[:3, 3])
    SubElement(emitter, "point", name="position", x=x, y=y, z=z)


def _rigid(matrix: Matrix) -> Matrix:
    """The rotation and the place of a matrix, without its scale."""
    made = np.eye(4)
    u, _, v = np.linalg.svd(matrix[:3, :3])
    made[:3, :3] = u @ v if np.linalg.det(u @ v) > 0 else u @ np.diag([1, 1, -1]) @ v
    made[:3, 3] = matrix[:3, 3]
    return made


def _matrix(node: Node) -> Matrix:
    """A node's transform in its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    made = np.eye(4)
    made[:3, :3] = turned * np.array(node.get("scale", (1, 1, 1)), np.float64)
    made[:3, 3] = node.get("translation", (0, 0, 0))
    return made


def _triangles(order: NDArray[np.uint32], mode: int) -> NDArray[np.uint32]:
    """The triangles (F, 3) of a list, a strip or a fan of vertices."""
    if mode == _LISTS:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    n = max(len(order) - 2, 0)
    i = np.arange(n)
    if mode == _FANS:
        return np.stack([np.broadcast_to(order[:1], n), order[i + 1], order[i + 2]], axis=1)
    odd = i % 2
    return np.stack([order[i], order[i + 1 + odd], order[i + 2 - odd]], axis=1)
