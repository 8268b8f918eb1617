"""glTF and GLB: the nodes of a scene as shapes, by the names of nodes, with lights and the camera. Metres, y up.

Letters: V vertices, F faces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import SubElement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.elements import WIDEST, put_cones
from photonfarm.renderer.tools.importing.imported import Floats, ImportedScene, Mesh
from photonfarm.renderer.tools.importing.readers.gltf_file import GltfFile, Node, extension, normalise, numbers
from photonfarm.renderer.tools.importing.readers.gltf_materials import Look, Materials

OBJECT_SHARE = 0.34
"""A node is an object as a whole up to this share of all meshes; above, it is a folder of objects."""

_ONE_COLOUR = 2e-3  # colours of vertices that differ by no more are one colour
_UNNAMED = (0.8, 0.8, 0.8, 1.0)  # the colour of what has neither a material nor colours of vertices
_ASKEW = 0.5  # tangents whose cosine with the images' own ones is below this are others
_MANY_ASKEW = 0.1  # the share of faces that is many

_LIGHTS, _INSTANCES = "KHR_lights_punctual", "EXT_mesh_gpu_instancing"
_OF_BLENDER = (
    "lamps are in candela and lux, as glTF has them; Blender writes them 683 times as bright as surfaces that shine; "
    'export with Lighting Mode "Unitless", or import the .blend'
)
_AT_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
_LISTS, _STRIPS, _FANS = 4, 5, 6  # the modes of primitives that are triangles
_OTHERS = dict(enumerate(("POINTS", "LINES", "LINE_LOOP", "LINE_STRIP")))

_WIDTHS = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (4,), "TEXCOORD": (2,), "COLOR": (3, 4)}
"""How many numbers attributes have; those of other names have no effect."""

_Piece = tuple[Mesh, Look]  # a mesh and its material


def read(path: Path, scratch: Path, log: Log, scene: ImportedScene | None = None) -> ImportedScene:
    """Read a file into a scene; images go into the folder `scratch`. Raises SpecError for what cannot be read."""
    scene = scene or ImportedScene()
    file = GltfFile(path, scene.changes)
    with file.at(), np.errstate(invalid="ignore"):  # of corners that are infinite, which are said
        log(f"reading {len(file.all('nodes'))} nodes and {len(file.all('meshes'))} meshes of {path.name}")
        _Reader(file, scene, Materials(file, scene, scratch)).read()
    if scene.root.find("shape") is None:
        changes = "".join(f"\n  {change}" for change in sorted(scene.changes, key=lambda change: not change.effect))
        raise SpecError(f"{path}: its scene has no triangles; nothing can be rendered{changes}")
    return scene


@dataclass(slots=True, eq=False)
class _Visit:
    """A visible node where the scene has it."""

    node: Node
    name: str
    matrix: Floats  # to the world
    above: tuple[_Visit, ...]  # from the root on
    meshes: int = 0  # at it and below it
    owner: str = ""  # the object that it is part of

    @property
    def place(self) -> str:
        """The node as a message names it."""
        return f"node {self.name!r}"


@dataclass(slots=True)
class _Reader:
    file: GltfFile
    scene: ImportedScene
    materials: Materials

    def read(self) -> None:
        """Read all nodes of the file's scene."""
        if self.file.all("animations"):
            self.scene.changes.note("all stands as its nodes place it at rest", name="animations")
        visits = list(self._visits())
        self._find_owners(visits)
        for x, y, z in [visit.matrix[:3, 3].tolist() for visit in visits if "camera" in visit.node][:1]:
            self.scene.camera = (x, y, z)
        pieces = [piece for visit in visits if "mesh" in visit.node for piece in self._pieces(visit)]
        for made, owner, mesh, look in pieces:  # materials need to know all meshes that have them
            with self.file.at(f"material {self.materials.name(look)!r}"):
                if self.materials.is_unseen(look):
                    self.scene.changes.note(
                        "what is wholly transparent is left out", f"node {made!r}", name="alphaMode"
                    )
                    continue
                material, light = self.materials.make(look)
                both_sides = bool(self.materials.entry(look.number).get("doubleSided"))
                self.scene.put_shape(made, mesh, material, owner, light, both_sides=both_sides)
        lights = extension(self.file.document, _LIGHTS).get("lights", [])
        if lights and str(self.file.document["asset"].get("generator")).startswith("Khronos glTF Blender I/O"):
            self.scene.changes.note(_OF_BLENDER, name=_LIGHTS)
        for visit in visits:
            number = extension(visit.node, _LIGHTS).get("light")
            if number is not None:
                with self.file.at(visit.place):
                    self._put_light(self.file.entry("lights", number, lights), visit.matrix)

    def _visits(self) -> Iterator[_Visit]:
        """The visible nodes, each after the ones above it."""
        waiting: list[tuple[int, tuple[_Visit, ...]]] = [(number, ()) for number in reversed(self._roots())]
        while waiting:
            number, above = waiting.pop()
            node = self.file.entry("nodes", number)
            if not extension(node, "KHR_node_visibility").get("visible", True):
                continue
            name = node.get("name") or ("mesh" in node and self.file.entry("meshes", node["mesh"]).get("name"))
            visit = _Visit(node, str(name or f"node_{number}"), np.eye(4), above)
            with self.file.at(visit.place):
                if any(each.node is node for each in above):
                    raise SpecError("is below itself; take it out of its children")
                visit.matrix = (above[-1].matrix if above else np.eye(4)) @ _matrix(node)
                waiting += [(child, (*above, visit)) for child in reversed(node.get("children", ()))]
            yield visit

    def _roots(self) -> list[int]:
        if not (count := len(self.file.all("scenes"))):
            below = {child for node in self.file.all("nodes") for child in node.get("children", ())}
            return [number for number in range(len(self.file.all("nodes"))) if number not in below]
        scene = self.file.entry("scenes", self.file.document.get("scene", 0))
        if count > 1:
            self.scene.changes.note(f"{scene.get('name', 'one')!r} of {count} is read", name="scenes")
        return list(scene.get("nodes", ()))

    def _find_owners(self, visits: list[_Visit]) -> None:
        """Learn which object each node is part of: the first from the root on that is no folder of objects."""
        for visit in visits:
            for each in (*visit.above, visit):
                each.meshes += "mesh" in visit.node
        most = max(1.0, OBJECT_SHARE * sum("mesh" in visit.node for visit in visits))
        for visit in visits:
            visit.owner = next((each.name for each in visit.above if each.meshes <= most), visit.name)

    def _pieces(self, visit: _Visit) -> Iterator[tuple[str, str, Mesh, Look]]:
        """The ids, objects, meshes in the world and materials of a node."""
        with self.file.at(visit.place):
            mesh = self.file.entry("meshes", visit.node["mesh"])
            if "skin" in visit.node:
                self.scene.changes.lose("geometry", "skin", "joints move nothing; it stands as modelled", visit.place)
            if np.any(visit.node.get("weights", mesh.get("weights", ()))):
                self.scene.changes.lose("geometry", "weights", "morph targets move nothing", visit.place)
            for name, owner, matrix in self._instances(visit):
                for number, primitive in enumerate(mesh["primitives"]):
                    called = f"{name}_{number}" if len(mesh["primitives"]) > 1 else name
                    for part, look in self._meshes(primitive, matrix, visit.place):
                        yield self.scene.ids.make(called), owner, part, look

    def _instances(self, visit: _Visit) -> Iterator[tuple[str, str, Floats]]:
        """The names, objects and transforms of a node's mesh: one, or one for each instance, its own object."""
        instances = extension(visit.node, _INSTANCES).get("attributes")
        if not instances:
            yield visit.name, visit.owner, visit.matrix
            return
        count = self.file.entry("accessors", next(iter(instances.values())))["count"]
        values = {}
        for key, number in instances.items():
            if key.lower() in _AT_REST:
                values[key.lower()] = self.file.array(number, key, [len(_AT_REST[key.lower()])], count)
            elif not key.startswith("_"):
                self.scene.changes.lose("colour", key, f"{_INSTANCES} has no such attribute", visit.place)
        for number in range(count):
            name = f"{visit.name}_{number}"
            yield name, name, visit.matrix @ _matrix({key: each[number] for key, each in values.items()})

    def _meshes(self, primitive: Node, matrix: Floats, place: str) -> list[_Piece]:
        """The meshes of a primitive: none if it has no triangles, and two where some of its images are mirrored."""
        mode, attributes, material = primitive.get("mode", _LISTS), primitive["attributes"], primitive.get("material")
        if mode not in (_LISTS, _STRIPS, _FANS) or "POSITION" not in attributes:
            name = _OTHERS.get(mode, f"mode {mode}") if "POSITION" in attributes else "no POSITION"
            self.scene.changes.lose("geometry", name, "points, lines and what is nowhere have no surface", place)
            return []
        count = self.file.entry("accessors", attributes["POSITION"])["count"]
        values = {}
        for name, number in attributes.items():
            if (widths := _WIDTHS.get(name.split("_")[0])) is not None:
                read = self.file.array(number, name, widths, count)  # integers of colours are fractions in any case
                values[name] = normalise(read) if name.startswith("COLOR") else read.astype(np.float64)
        mesh = Mesh(values["POSITION"], self._faces(primitive, mode, count), values.get("NORMAL"))
        mesh = replace(mesh, uv=self._uv(values, material, place))
        mesh, look = self._colour(mesh, values.get("COLOR_0"), material, place)
        mesh = mesh.transform(matrix)
        if mesh.uv is None or "normalTexture" not in self.materials.entry(material):
            return [(mesh, look)]
        along, areas = _lie_of_images(mesh, mesh.uv)
        mirrored = areas > 0
        if (tangents := values.get("TANGENT")) is not None:
            mirrored = tangents[mesh.faces, 3].sum(axis=1) * np.linalg.det(matrix[:3, :3]) < 0
            given = (tangents[:, :3] @ matrix[:3, :3].T)[mesh.faces].sum(axis=1)
            lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(given, axis=1)
            if ((along * given).sum(axis=1) < _ASKEW * lengths).sum() > _MANY_ASKEW * len(lengths):
                meaning = "normal maps lie by their texture coordinates alone"
                self.scene.changes.lose("colour", "TANGENT", meaning, place)
        parts = [(mesh.part(mirrored == side), look._replace(mirrored=side)) for side in (False, True)]
        return [part for part in parts if len(part[0].faces)]

    def _faces(self, primitive: Node, mode: int, vertices: int) -> NDArray[np.uint32]:
        """The triangles (F, 3) of a list, a strip or a fan of vertices."""
        order = np.arange(vertices, dtype=np.uint32)
        if "indices" in primitive:
            order = self.file.array(primitive["indices"], "indices", [1])[:, 0]
        if order.dtype.kind != "u" or order.max(initial=0) >= max(vertices, 1):
            raise SpecError(f"indices ({order.dtype}) name vertex {order.max()}, and POSITION has {vertices}")
        if mode == _LISTS:
            return order[: len(order) // 3 * 3].reshape(-1, 3).astype(np.uint32)
        i = np.arange(len(order) - 2)
        first, odd = (i, i % 2) if mode == _STRIPS else (0 * i, 0 * i)
        return order[np.stack([first, i + 1 + odd, i + 2 - odd], axis=1)].astype(np.uint32)

    def _uv(self, values: Mapping[str, Floats], material: int | None, place: str) -> Floats | None:
        """The texture coordinates by which a material's images lie."""
        used = self.materials.find_uv_sets(material)
        first, *others = [f"TEXCOORD_{number}" for number in used or [0]]
        if first not in values:
            if used:
                self.scene.changes.note("is not there, and images show the colour of their corner", place, name=first)
            return np.zeros((len(values["POSITION"]), 2)) if used else None
        for name in others:
            if not np.array_equal(values.get(name, values[first]), values[first]):
                meaning = f"meshes have one set of texture coordinates, so that all images lie by {first}"
                self.scene.changes.lose("colour", name, meaning, place)
        self.materials.extend(material, values[first])
        return values[first]

    def _colour(self, mesh: Mesh, colours: Floats | None, number: int | None, place: str) -> _Piece:
        """A mesh with its colours of vertices, if they differ, or a material with their one colour."""
        if colours is None or not len(mesh.faces):
            if number is not None:
                return mesh, Look(number)
            self.scene.changes.note("what has no material is light grey", place)
            return mesh, Look(None, tint=_UNNAMED)
        used = colours[np.unique(mesh.faces)]
        used = np.column_stack([used, np.ones((len(used), 4 - used.shape[1]))])
        mean, same = np.round(used.mean(axis=0), 4).tolist(), np.ptp(used, axis=0) <= _ONE_COLOUR
        entry = self.materials.entry(number)
        if not same[3] and entry.get("alphaMode", "OPAQUE") != "OPAQUE":
            self.scene.changes.lose("colour", "COLOR_0", "the alpha of vertices is their mean", place)
        if same[:3].all():
            return mesh, Look(number, tint=tuple(mean))
        look, surface = Look(number, tint=(1.0, 1.0, 1.0, mean[3])), entry.get("pbrMetallicRoughness", {})
        if "baseColorTexture" in surface:
            meaning = "colours of vertices multiply a plain colour of metallic-roughness alone, and are left out"
            self.scene.changes.lose("colour", "COLOR_0", meaning, place)
            return mesh, look
        factor = numbers(surface, "baseColorFactor", (1, 1, 1, 1))[:3]
        painted = {"vertex_color": (colours[:, :3] * factor).clip(0, 1)}
        return replace(mesh, attributes=painted), look._replace(painted=True)

    def _put_light(self, light: Node, matrix: Floats) -> None:
        """Candela and lux are taken as radiometric units, as emissive strength is, so that all lights agree."""
        kind, name = light["type"], light.get("name", light["type"])
        place = f"light {name!r}"
        if kind not in ("point", "spot", "directional"):
            self.scene.changes.lose("light", str(kind), "is no kind of light that is known", place)
            return
        colour = light.get("intensity", 1.0) * numbers(light, "color", (1, 1, 1))
        if colour.min() < 0:
            self.scene.changes.lose("light", "intensity", "is negative, which no light is here", place)
        if colour.max() <= 0:
            return
        if "range" in light:
            self.scene.changes.note("light does not end there", place, name="range")
        emitter = SubElement(self.scene.root, "emitter", type=kind, id=self.scene.ids.make(name))
        elements.put_value(emitter, "irradiance" if kind == "directional" else "intensity", colour.clip(0).tolist())
        to_world = np.eye(4)
        to_world[:3, 3] = matrix[:3, 3]
        if matrix[:3, 2].any():  # it shines along −z, and Mitsuba's along +z
            to_world[:3, :3] = Rotation.align_vectors(-matrix[:3, 2], (0, 0, 1))[0].as_matrix()
        elements.put_matrix(emitter, "to_world", to_world.tolist())
        if kind != "spot":
            return
        spot = light.get("spot", {})  # which fades by the attenuation that the extension recommends
        inner, outer = spot.get("innerConeAngle", 0.0), spot.get("outerConeAngle", np.pi / 4)
        if not 0 <= inner <= outer <= np.pi / 2 or outer == 0:
            meaning = f"{inner} and {outer} are no angles from 0 to π/2, of which the outer one is greater"
            self.scene.changes.lose("light", "outerConeAngle", meaning, place)
        cut = float(np.clip(outer, 1e-3, WIDEST))

        def profile(x: Floats, y: Floats) -> Floats:
            cosine, edge = 1 / np.sqrt(1 + x * x + y * y), np.cos(outer)
            return np.clip((cosine - edge) / max(1e-3, np.cos(inner) - edge), 0, 1) ** 2

        put_cones([emitter], profile, cut, self.materials.scratch / f"{emitter.get('id')}_cone.png")


def _matrix(node: Node) -> Floats:
    """A node's transform in its parent."""
    if "matrix" in node:
        return numbers(node, "matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T
    made = np.eye(4)
    made[:3, 3], turn, scale = (numbers(node, key, default) for key, default in _AT_REST.items())
    if not turn.any():
        raise ValueError("rotation is 0, 0, 0, 0, which is no rotation")
    made[:3, :3] = Rotation.from_quat(turn).as_matrix() * scale
    return made


def _lie_of_images(mesh: Mesh, uv: Floats) -> tuple[Floats, Floats]:
    """How images lie on faces: the direction in which u grows (F, 3), and their signed areas (F,).

    The area is negative where an image, whose v is downwards, is not mirrored.
    """
    a, b = (mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, 0]] for i in (1, 2))
    c, d = (uv[mesh.faces[:, i]] - uv[mesh.faces[:, 0]] for i in (1, 2))
    area = c[:, :1] * d[:, 1:] - c[:, 1:] * d[:, :1]
    return np.sign(area) * (a * d[:, 1:] - b * c[:, 1:]), area[:, 0]
