"""glTF and GLB: the nodes of a scene as shapes, by the names of nodes, with lights and the camera. Metres, y up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Floats, Mesh
from photonfarm.renderer.importing.readers.blender_lamps import WIDEST, cone_image, put_cone
from photonfarm.renderer.importing.readers.gltf_file import GltfFile, Node, extension, numbers
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
    with file.at():
        _Reader(file, scene, materials, log, ids).read()
    if scene.root.find("shape") is None:
        found = "".join(f"\n  {change}" for change in scene.changes)
        raise SpecError(f"{path}: its scene has no triangles; nothing can be rendered{found}")
    return scene


@dataclass(slots=True, eq=False)
class _Visit:
    """A node where the scene has it."""

    number: int
    above: _Visit | None
    matrix: Floats  # to the world
    path: frozenset[int] = frozenset()  # all nodes above it
    hidden: bool = False
    name: str = ""
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
        pieces: list[tuple[Mesh, Look, str, str]] = []
        for visit in visits:
            with self.file.at(f"node {visit.name!r}"):
                pieces += self._pieces(visit) if "mesh" in nodes[visit.number] else ()
        for piece in pieces:  # materials need to know all meshes that have them
            with self.file.at(self.materials.place(piece[1])):
                self._put_piece(*piece)
        lights = extension(self.file.document, _LIGHTS).get("lights", [])
        for visit in visits:
            with self.file.at(f"node {visit.name!r}"):
                self.file.report(nodes[visit.number], "geometry", f"node {visit.name!r}")
                number = extension(nodes[visit.number], _LIGHTS).get("light")
                if number is not None:
                    self._put_light(self.file.entry("lights", number, lights), visit.matrix)

    def _visits(self) -> list[_Visit]:
        """The visible nodes, each after the one above it; skins need to know where the hidden ones are."""
        visits: list[_Visit] = []
        waiting = [_Visit(number, None, np.eye(4)) for number in reversed(self._roots())]
        while waiting:
            visit = waiting.pop()
            node = self.file.entry("nodes", visit.number)
            visit.name = str(node.get("name") or f"node_{visit.number}")
            with self.file.at(f"node {visit.name!r}"):
                self._enter(visit, node)
                path, below = visit.path | {visit.number}, reversed(node.get("children", ()))
                waiting += [_Visit(child, visit, visit.matrix, path, visit.hidden) for child in below]
            visits += [] if visit.hidden else [visit]
        return visits

    def _enter(self, visit: _Visit, node: Node) -> None:
        """Learn a node's name, its place, and whether it is hidden."""
        if visit.number in visit.path:
            raise SpecError("is below itself; take it out of its children")
        if "mesh" in node:
            visit.name = str(node.get("name") or self.file.entry("meshes", node["mesh"]).get("name") or visit.name)
        visit.matrix = visit.matrix @ _matrix(node)
        visit.hidden |= not extension(node, "KHR_node_visibility").get("visible", True)
        self.worlds.setdefault(visit.number, visit.matrix)
        if "camera" in node and self.scene.camera is None:
            x, y, z = visit.matrix[:3, 3].tolist()
            self.scene.camera = (x, y, z)

    def _roots(self) -> list[int]:
        scenes = self.file.all("scenes")
        if scenes:
            scene = self.file.entry("scenes", self.file.document.get("scene", 0))
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
                visit.owner = visit.name

    # ------------------------------------------------------------------------------------------------------ meshes

    def _pieces(self, visit: _Visit) -> Iterator[tuple[Mesh, Look, str, str]]:
        """The meshes of a node in the world, with their materials, ids and objects."""
        node, name = self.file.all("nodes")[visit.number], visit.name
        mesh = self.file.entry("meshes", node["mesh"])
        self.file.report(mesh, "geometry", f"node {name!r}")
        weights = node.get("weights", mesh.get("weights", ()))
        meshes = Meshes(self.file, self.materials, self.worlds)
        for at in self._places(node, name, visit):
            for number, primitive in enumerate(mesh["primitives"]):
                called = f"{at.name}_{number}" if len(mesh["primitives"]) > 1 else at.name
                for part, look in meshes.pieces(primitive, weights, at):
                    yield part, look, self.ids.make(called), at.owner

    def _put_piece(self, mesh: Mesh, look: Look, made: str, owner: str) -> None:
        material = self.materials.made(look)
        if material is None:
            self.scene.changes.note("what is wholly transparent is left out", f"node {made!r}", name="alphaMode")
            return
        both = bool(self.materials.entry(look.number).get("doubleSided"))
        self.scene.put_shape(made, mesh, material[0], owner, material[1], both_sides=both)

    def _places(self, node: Node, name: str, visit: _Visit) -> list[Placed]:
        """Where a node's mesh is: once, or as often as it has instances, which are objects of their own."""
        instances = extension(node, _INSTANCES).get("attributes")
        if not instances:
            return [Placed(node, name, visit.matrix, visit.owner or name)]
        count = self.file.entry("accessors", next(iter(instances.values())))["count"]
        values = {key: self.file.attribute(number, key, count, (len(_DEFAULTS[_PARTS[key]]),))
                  for key, number in instances.items() if key in _PARTS}  # fmt: skip
        for key in instances:
            if key not in _PARTS and not key.startswith("_"):
                self.scene.changes.lose("colour", key, f"{_INSTANCES} has no such attribute", f"node {name!r}")
        made = []
        for number in range(count):
            parts = {_PARTS[key]: each[number] for key, each in values.items()}
            made.append(Placed(node, f"{name}_{number}", visit.matrix @ _matrix(parts), f"{name}_{number}"))
        return made

    # ------------------------------------------------------------------------------------------------------ lights

    def _put_light(self, light: Node, matrix: Floats) -> None:
        """Candela and lux are taken as radiometric units, as emissive strength is, so that all lights agree."""
        kind, name = light["type"], light.get("name", light["type"])
        self.file.report(light, "light", f"light {name!r}")
        colour = light.get("intensity", 1.0) * numbers(light, "color", (1, 1, 1))
        if colour.min() < 0:
            self.scene.changes.lose("light", "intensity", "is negative, which no light is here", f"light {name!r}")
        if kind not in ("point", "spot", "directional"):
            self.scene.changes.lose("light", str(kind), "is no kind of light that is known", f"light {name!r}")
            return
        if colour.max() <= 0:
            return
        if "range" in light:
            self.scene.changes.note("light does not end there", f"light {name!r}", name="range")
        emitter = SubElement(self.scene.root, "emitter", type=kind, id=self.ids.make(name))
        elements.put_value(emitter, "irradiance" if kind == "directional" else "intensity", colour.clip(0).tolist())
        if kind == "point":
            place = {axis: f"{part:.10g}" for axis, part in zip("xyz", matrix[:3, 3], strict=True)}
            SubElement(emitter, "point", {"name": "position", **place})
            return
        facing = np.diag([-1.0, 1.0, -1.0, 1.0])  # glTF's lights shine along −z, Mitsuba's along +z
        elements.put_matrix(emitter, "to_world", (_rigid(matrix) @ facing).tolist())
        if kind == "spot":
            self._put_cone(emitter, light.get("spot", {}), f"light {name!r}")

    def _put_cone(self, emitter: Element, spot: Node, place: str) -> None:
        """Let a spot fade by the attenuation that the extension recommends."""
        inner, outer = spot.get("innerConeAngle", 0.0), spot.get("outerConeAngle", np.pi / 4)
        if not 0 <= inner <= outer <= np.pi / 2 or outer == 0:
            meaning = f"{inner} and {outer} are no angles from 0 to π/2, of which the outer one is greater"
            self.scene.changes.lose("light", "outerConeAngle", meaning, place)
        cut = float(np.clip(outer, 1e-3, WIDEST))

        def profile(x: Floats, y: Floats) -> Floats:
            cosine, edge = 1 / np.sqrt(1 + x * x + y * y), np.cos(outer)
            return np.clip((cosine - edge) / max(1e-3, np.cos(inner) - edge), 0, 1) ** 2

        file = self.materials.textures.scratch / f"{emitter.get('id')}_cone.png"
        put_cone(emitter, cut, cone_image(profile, cut, file))


_DEFAULTS = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}

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
        return numbers(node, "matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T
    made = np.eye(4)
    made[:3, 3], turn, scale = (numbers(node, key, default) for key, default in _DEFAULTS.items())
    if not turn.any():
        raise ValueError("rotation is 0, 0, 0, 0, which is no rotation")
    made[:3, :3] = Rotation.from_quat(turn).as_matrix() * scale
    return made
