"""glTF's primitives as meshes in the world: morph targets, skins, colours of vertices, mirrored images.

Letters: V vertices, F faces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.meshes import Floats, Mesh
from photonfarm.renderer.importing.readers.gltf_file import COMPRESSED, GltfFile, Node, normalised
from photonfarm.renderer.importing.readers.gltf_materials import Look, Materials
from photonfarm.shared.core.errors import SpecError

_LISTS, _STRIPS, _FANS = 4, 5, 6
"""The modes of primitives that are triangles."""

_NAMES = dict(enumerate(("POINTS", "LINES", "LINE_LOOP", "LINE_STRIP", *["POSITION"] * 3)))
"""What is missing or no triangles, by the mode."""

_WIDTHS = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (4,), "TEXCOORD": (2,), "COLOR": (3, 4), "JOINTS": (4,),
           "WEIGHTS": (4,)}  # fmt: skip
"""How many numbers attributes have; those of other names have no effect."""

_NOT_PLAIN = "only a plain colour of metallic-roughness is multiplied by colours of vertices, which are left out"

ONE_COLOUR = 2e-3
"""Colours of vertices that differ by no more are one colour."""

UNNAMED = (0.8, 0.8, 0.8, 1.0)
"""The colour of what has neither a material nor colours of vertices."""

ASKEW, MANY_ASKEW = 0.5, 0.1
"""Tangents whose cosine with the images' own ones is below this are others, and this share of faces is many."""

Values = Mapping[str, Floats]
"""The attributes of vertices (V, width), by their names."""

Piece = tuple[Mesh, Look]
"""A mesh in the world, and its material."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A mesh of the file at a node."""

    node: Node
    name: str
    matrix: Floats  # (4, 4)
    owner: str


@dataclass(slots=True)
class Meshes:
    """The primitives of a file, placed in the world."""

    file: GltfFile
    materials: Materials
    worlds: Mapping[int, Floats]  # the transforms (4, 4) of nodes

    def pieces(self, primitive: Node, weights: Sequence[float], at: Placed) -> list[Piece]:
        """The meshes of a primitive: none if it has no triangles, and two where some of its images are mirrored."""
        place, attributes = f"node {at.name!r}", primitive["attributes"]
        self.file.report(primitive, "geometry", place)
        mode = primitive.get("mode", _LISTS)
        if mode not in (_LISTS, _STRIPS, _FANS) or "POSITION" not in attributes:
            name = _NAMES.get(mode, f"mode {mode}")
            self.file.changes.lose("geometry", name, "points, lines and what has no positions have no surface", place)
            return []
        self._refuse_compressed(primitive)
        values = {name: self._attribute(primitive, name, weights) for name in attributes if _stem(name) in _WIDTHS}
        mesh = Mesh(values["POSITION"], self._faces(primitive, mode, len(values["POSITION"])), values.get("NORMAL"))
        mesh = replace(mesh, uv=self._uv(values, primitive.get("material"), mesh, place))
        mesh, look = self._coloured(mesh, values.get("COLOR_0"), primitive.get("material"), place)
        return self._placed(mesh, look, values, at)

    def _refuse_compressed(self, primitive: Node) -> None:
        names = COMPRESSED & set(primitive.get("extensions", ()))
        position = self.file.entry("accessors", primitive["attributes"]["POSITION"])
        if names and not {"bufferView", "sparse"} & set(position):
            raise SpecError(f"a mesh is in {', '.join(names)}, which is not read; export it without")

    def _attribute(self, primitive: Node, name: str, weights: Sequence[float]) -> Floats:
        """An attribute (V, width) with its morph targets."""
        attributes, widths = primitive["attributes"], _WIDTHS[_stem(name)]
        count = self.file.entry("accessors", attributes["POSITION"])["count"]
        values = self.file.attribute(attributes[name], name, count, widths)
        if name.startswith(("COLOR", "WEIGHTS")):
            values = normalised(values)  # integers mean nothing else here, whether they say so or not
        values = values.astype(np.float64)
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            if weight and name in target:
                widths = (3,) if name == "TANGENT" else (values.shape[1],)  # whose fourth number is a sign
                change = self.file.attribute(target[name], f"{name} of a morph target", count, widths)
                values[:, : change.shape[1]] += weight * change
        return values

    def _faces(self, primitive: Node, mode: int, vertices: int) -> NDArray[np.uint32]:
        order = np.arange(vertices) if "indices" not in primitive else self.file.array(primitive["indices"])[:, 0]
        if "indices" in primitive and order.dtype.kind != "u":
            raise SpecError(f"indices are of {order.dtype}; they must be unsigned integers")
        if order.size and order.max() >= vertices:
            raise SpecError(f"indices name vertex {order.max()}, and POSITION has {vertices}")
        return _triangles(order.astype(np.uint32), mode)

    # -------------------------------------------------------------------------------------------------- materials

    def _uv(self, values: Values, material: int | None, mesh: Mesh, place: str) -> Floats | None:
        """The texture coordinates by which a material's images lie."""
        used = self.materials.uv_sets(material)
        names = [f"TEXCOORD_{number}" for number in used or [0]]
        if names[0] not in values:
            if used:
                self.file.changes.note("is not there, and images show the colour of their corner", place, name=names[0])
            return np.zeros((len(mesh.vertices), 2)) if used else None
        for name in names[1:]:
            if not np.array_equal(values.get(name, values[names[0]]), values[names[0]]):
                meaning = f"meshes have one set of texture coordinates, so that all images lie by {names[0]}"
                self.file.changes.lose("colour", name, meaning, place)
        self.materials.extend(material, values[names[0]])
        return values[names[0]]

    def _coloured(self, mesh: Mesh, colours: Floats | None, number: int | None, place: str) -> Piece:
        """A mesh with its colours of vertices, if they differ, or a material with their one colour."""
        if colours is None or not len(mesh.faces):
            if number is not None:
                return mesh, Look(number)
            self.file.changes.note("what has no material is light grey", place)
            return mesh, Look(None, tint=UNNAMED)
        used = colours[np.unique(mesh.faces)]
        used = np.column_stack([used, np.ones((len(used), 4 - used.shape[1]))])
        mean = np.round(used.mean(axis=0), 4)
        same = np.ptp(used, axis=0) <= ONE_COLOUR
        if not same[3] and self.materials.entry(number).get("alphaMode", "OPAQUE") != "OPAQUE":
            self.file.changes.lose("colour", "COLOR_0", "the alpha of vertices is their mean", place)
        if same[:3].all():
            return mesh, Look(number, tint=tuple(mean.tolist()))
        (has_image, factor), tint = self.materials.colour(number), (1.0, 1.0, 1.0, float(mean[3]))
        if has_image:
            self.file.changes.lose("colour", "COLOR_0", _NOT_PLAIN, place)
            return mesh, Look(number, tint=tint)
        return replace(mesh, colours=(colours[:, :3] * factor[:3]).clip(0, 1)), Look(number, tint=tint, painted=True)

    # -------------------------------------------------------------------------------------------------- placement

    def _placed(self, mesh: Mesh, look: Look, values: Values, at: Placed) -> list[Piece]:
        """A mesh in the world; where its images are mirrored, its normal map is."""
        joints = self._joints(values, at)
        mesh = mesh.moved(at.matrix) if joints is None else _skinned(mesh, joints)
        if mesh.uv is None or "normalTexture" not in self.materials.entry(look.number):
            return [(mesh, look)]
        along, areas = _images(mesh, mesh.uv)
        mirrored = areas > 0
        if "TANGENT" in values:
            moves = np.broadcast_to((at.matrix[None] if joints is None else joints)[:, :3, :3], (len(mesh.uv), 3, 3))
            mirrored = (values["TANGENT"][:, 3] * np.linalg.det(moves))[mesh.faces].sum(axis=1) < 0
            given = np.einsum("vij,vj->vi", moves, values["TANGENT"][:, :3])[mesh.faces].sum(axis=1)
            lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(given, axis=1)
            if ((along * given).sum(axis=1) < ASKEW * lengths).sum() > MANY_ASKEW * len(lengths):
                meaning = "normal maps lie by their texture coordinates alone"
                self.file.changes.lose("colour", "TANGENT", meaning, f"node {at.name!r}")
        if mirrored.all() or not mirrored.any():
            return [(mesh, look._replace(mirrored=bool(mirrored.any())))]
        return [(mesh.part(~mirrored), look), (mesh.part(mirrored), look._replace(mirrored=True))]

    def _joints(self, values: Values, at: Placed) -> Floats | None:
        """The transforms of the vertices of a skin to the world (V, 4, 4)."""
        if "skin" not in at.node or "JOINTS_0" not in values:
            return None
        skin = self.file.entry("skins", at.node["skin"])
        self.file.report(skin, "geometry", f"node {at.name!r}")
        if not all(joint in self.worlds for joint in skin["joints"]):
            self.file.changes.lose("geometry", "skin", "joints are not in the scene; it stands as modelled", at.name)
            return None
        matrices = np.stack([self.worlds[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = self.file.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            matrices = matrices @ inverse[: len(matrices)].transpose(0, 2, 1)
        moves = np.zeros((len(values["JOINTS_0"]), 4, 4))
        for name in [name for name in values if name.startswith("JOINTS_")]:
            for joint, weight in zip(values[name].T, values[name.replace("JOINTS", "WEIGHTS")].T, strict=True):
                moves += weight[:, None, None] * matrices[joint.astype(int)]
        return moves / np.where(moves[:, 3:, 3:] == 0, 1, moves[:, 3:, 3:])


def _stem(name: str) -> str:
    """The name of an attribute without its number."""
    return name.split("_", 1)[0]


def _skinned(mesh: Mesh, moves: Floats) -> Mesh:
    """A mesh whose vertices have transforms of their own (V, 4, 4)."""
    linear = moves[:, :3, :3]
    normals = mesh.normals
    if normals is not None:
        normals = np.einsum("vi,vij->vj", normals, np.linalg.pinv(linear))
    vertices = np.einsum("vij,vj->vi", linear, mesh.vertices) + moves[:, :3, 3]
    faces = mesh.faces[:, ::-1] if np.median(np.linalg.det(linear)) < 0 else mesh.faces
    return replace(mesh, vertices=vertices, normals=normals, faces=faces)


def _images(mesh: Mesh, uv: Floats) -> tuple[Floats, Floats]:
    """How images lie on faces: the direction in which u grows (F, 3), and their signed areas (F,).

    The area is negative where an image, whose v is downwards, is not mirrored.
    """
    a, b = (mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, 0]] for i in (1, 2))
    c, d = (uv[mesh.faces[:, i]] - uv[mesh.faces[:, 0]] for i in (1, 2))
    area = c[:, :1] * d[:, 1:] - c[:, 1:] * d[:, :1]
    return np.sign(area) * (a * d[:, 1:] - b * c[:, 1:]), area[:, 0]


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
