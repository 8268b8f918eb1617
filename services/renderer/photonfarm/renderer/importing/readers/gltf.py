"""glTF and GLB: the nodes of a scene as shapes, by the names of nodes, with lights and the camera. Metres, y up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Floats, Mesh
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node, extension
from photonfarm.renderer.importing.readers.gltf_materials import Look, Materials
from photonfarm.renderer.importing.readers.gltf_meshes import Meshes, Placed
from photonfarm.renderer.importing.readers.gltf_textures import Textures
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log

OBJECT_SHARE = 0.34
"""A node is an object as a whole up to this share of all meshes; above, it is a folder of objects."""

_LIGHTS = "KHR_lights_punctual"
_INSTANCES = "EXT_mesh_gpu_instancing"


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file; meshes and images are put into the folder `scratch`. Raises SpecError for what cannot be read."""
    scene, ids = ImportedScene(), Ids()
    file = GltfFile(path, scene.changes)
    materials = Materials(file, scene.root, Textures(file, scratch), ids)
    try:
        _Reader(file, scene, materials, log, ids).read()
    except SpecError:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise SpecError(f"{path}: is not valid glTF: {type(error).__name__}: {error}") from error
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: its scene has no triangles; nothing can be rendered")
    return scene


@dataclass(slots=True, eq=False)
class _Visit:
    """A node where the scene has it."""

    number: int
    above: _Visit | None
    matrix: Floats  # to the world
    path: frozenset[int] = frozenset()  # all nodes above it
    meshes: int = 0  # at it and below it
    owner: str = ""  # the object that it belongs to


@dataclass(slots=True)
class _Reader:
    file: GltfFile
    scene: ImportedScene
    materials: Materials
    log: Log
    ids: Ids
    worlds: dict[int, Floats] = field(default_factory=dict)

    def read(self) -> None:
        """Read all nodes of the file's scene."""
        nodes = self.file.all("nodes")
        self.log(f"reading {len(nodes)} nodes and {len(self.file.all('meshes'))} meshes of {self.file.path.name}")
        if self.file.all("animations"):
            self.scene.changes.note("all stands as its nodes place it at rest", name="animations")
        visits = self._visits()
        self._find_owners(visits, max(1, sum("mesh" in node for node in nodes)))
        pieces = [piece for visit in visits if "mesh" in nodes[visit.number] for piece in self._pieces(visit)]
        for mesh, look, made, owner in pieces:  # materials need to know all meshes that have them
            material = self.materials.made(look)
            if material is not None:
                both = bool(self.materials.entry(look.number).get("doubleSided"))
                self.scene.put_shape(made, mesh, material[0], owner, material[1], both_sides=both)
        for visit in visits:
            self.file.report(nodes[visit.number], "geometry", f"node {self._name(visit)!r}")
            number = extension(nodes[visit.number], _LIGHTS).get("light")
            if number is not None:
                self._put_light(self.file.document["extensions"][_LIGHTS]["lights"][number], visit.matrix)

    def _visits(self) -> list[_Visit]:
        """The visible nodes, each after the one above it."""
        visits: list[_Visit] = []
        waiting = [_Visit(number, None, np.eye(4)) for number in reversed(self._roots())]
        while waiting:
            visit = waiting.pop()
            node = self.file.all("nodes")[visit.number]
            if visit.number in visit.path:
                raise SpecError(f"{self.file.path}: node {visit.number} is below itself; take it out of its children")
            visit.matrix = visit.matrix @ _matrix(node)
            self.worlds.setdefault(visit.number, visit.matrix)
            if "camera" in node and self.scene.camera is None:
                x, y, z = visit.matrix[:3, 3].tolist()
                self.scene.camera = (x, y, z)
            if extension(node, "KHR_node_visibility").get("visible", True):
                visits.append(visit)
                path, below = visit.path | {visit.number}, reversed(node.get("children", ()))
                waiting += [_Visit(child, visit, visit.matrix, path) for child in below]
        return visits

    def _roots(self) -> list[int]:
        scenes = self.file.all("scenes")
        if scenes:
            scene = scenes[self.file.document.get("scene", 0)]
            if len(scenes) > 1:
                self.scene.changes.note(f"{scene.get('name', 'one')!r} of {len(scenes)} is read", name="scenes")
            self.file.report(scene, "light", "scene")
            return list(scene.get("nodes", ()))
        below = {child for node in self.file.all("nodes") for child in node.get("children", ())}
        return [number for number in range(len(self.file.all("nodes"))) if number not in below]

    def _find_owners(self, visits: list[_Visit], meshes: int) -> None:
        for visit in reversed(visits):
            visit.meshes += "mesh" in self.file.all("nodes")[visit.number]
            if visit.above is not None:
                visit.above.meshes += visit.meshes
        for visit in visits:
            visit.owner = visit.above.owner if visit.above is not None else ""
            if not visit.owner and visit.meshes <= max(1.0, OBJECT_SHARE * meshes):
                visit.owner = self._name(visit)

    def _name(self, visit: _Visit) -> str:
        node = self.file.all("nodes")[visit.number]
        named = node.get("name") or ("mesh" in node and self.file.all("meshes")[node["mesh"]].get("name"))
        return str(named or f"node_{visit.number}")

    # ------------------------------------------------------------------------------------------------------ meshes

    def _pieces(self, visit: _Visit) -> Iterator[tuple[Mesh, Look, str, str]]:
        """The meshes of a node in the world, with their materials, ids and objects."""
        node, name = self.file.all("nodes")[visit.number], self._name(visit)
        mesh = self.file.all("meshes")[node["mesh"]]
        self.file.report(mesh, "geometry", f"node {name!r}")
        weights = node.get("weights", mesh.get("weights", ()))
        meshes = Meshes(self.file, self.materials, self.worlds)
        for at in self._places(node, name, visit):
            for number, primitive in enumerate(mesh["primitives"]):
                called = f"{at.name}_{number}" if len(mesh["primitives"]) > 1 else at.name
                for part, look in meshes.pieces(primitive, weights, at):
                    yield part, look, self.ids.make(called), at.owner

    def _places(self, node: Node, name: str, visit: _Visit) -> list[Placed]:
        """Where a node's mesh is: once, or as often as it has instances, which are objects of their own."""
        instances = extension(node, _INSTANCES).get("attributes")
        if not instances:
            return [Placed(node, name, visit.matrix, visit.owner or name)]
        values = {key: self.file.array(number) for key, number in instances.items()}
        for key in values:
            if key not in _PARTS and not key.startswith("_"):
                self.scene.changes.lose("colour", key, f"{_INSTANCES} has no such attribute", f"node {name!r}")
        made = []
        for number in range(len(next(iter(values.values())))):
            parts = {_PARTS[key]: each[number] for key, each in values.items() if key in _PARTS}
            made.append(Placed(node, f"{name}_{number}", visit.matrix @ _matrix(parts), f"{name}_{number}"))
        return made

    # ------------------------------------------------------------------------------------------------------ lights

    def _put_light(self, light: Node, matrix: Floats) -> None:
        """Candela and lux are taken as radiometric units, as emissive strength is, so that all lights agree."""
        kind, name = light["type"], light.get("name", light["type"])
        self.file.report(light, "light", f"light {name!r}")
        colour = [light.get("intensity", 1.0) * part for part in light.get("color", (1, 1, 1))]
        if kind not in ("point", "spot", "directional"):
            self.scene.changes.lose("light", str(kind), "is no kind of light that is known", f"light {name!r}")
            return
        if max(colour) <= 0:
            return
        if "range" in light:
            self.scene.changes.note("light does not end there", f"light {name!r}", name="range")
        emitter = SubElement(self.scene.root, "emitter", type=kind, id=self.ids.make(name))
        elements.put_value(emitter, "irradiance" if kind == "directional" else "intensity", colour)
        if kind == "point":
            place = {axis: f"{part:.10g}" for axis, part in zip("xyz", matrix[:3, 3], strict=True)}
            SubElement(emitter, "point", {"name": "position", **place})
            return
        facing = np.diag([-1.0, 1.0, -1.0, 1.0])  # glTF's lights shine along −z, Mitsuba's along +z
        elements.put_matrix(emitter, "to_world", (_rigid(matrix) @ facing).tolist())
        if kind == "spot":
            self.scene.changes.note("the edge of its cone fades evenly", f"light {name!r}", name="spot")
            cone = light.get("spot", {})
            outer = np.degrees(cone.get("outerConeAngle", np.pi / 4))
            elements.put_value(emitter, "cutoff_angle", float(outer))
            inner = min(np.degrees(cone.get("innerConeAngle", 0.0)), 0.999 * outer)
            elements.put_value(emitter, "beam_width", float(inner))


_PARTS = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
"""The attributes of instances, as nodes have them."""


def _rigid(matrix: Floats) -> Floats:
    """The rotation and the place of a matrix, without its scale."""
    made = np.eye(4)
    u, _, v = np.linalg.svd(matrix[:3, :3])
    made[:3, :3] = u @ v if np.linalg.det(u @ v) > 0 else u @ np.diag([1, 1, -1]) @ v
    made[:3, 3] = matrix[:3, 3]
    return made


def _matrix(node: Node) -> Floats:
    """A node's transform in its parent."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    made = np.eye(4)
    made[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    made[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    made[:3, 3] = node.get("translation", (0, 0, 0))
    return made
