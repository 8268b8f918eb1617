"""Reads OBJ with MTL: one mesh for each material of each object, or of each group where the file names no objects.

Letters: K corners of all faces, N faces, T triangles.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from mapbox_earcut import triangulate_float64
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.changes import Changes
from photonfarm.renderer.tools.importing.imported import Floats, ImportedScene, Mesh, unit
from photonfarm.renderer.tools.importing.readers.mtl import WHITE, Material, read_libraries, statements

_WIDTHS = {"v": 6, "vt": 2, "vn": 3}
"""How many numbers are kept of each v, vt and vn; of a v these are x y z r g b."""

_NO_SURFACE = "p l curv curv2 vp cstype deg bmat step parm trim hole scrv sp end con ctech stech res mg lod bevel"
"""Statements that are left out: points and lines, free-form surfaces, and how finely or quickly to draw."""

_ROUNDING = 1e-6  # the error of a polygon's area, as a share of it, from which its triangles do not fill it

_Ints = NDArray[np.int64]

_Tables = tuple[Floats, Floats, Floats]
"""Rows x y z and linear r g b, u v with v downwards, and normals; the last u v and normal are NaN, for the index −1."""


class _Look(NamedTuple):
    """A material as a mesh has it."""

    material: Material
    painted: bool  # its colour is the mesh's attribute `vertex_color`
    mirrored: bool  # its images lie mirrored, and so its normal map does


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file; changed images are put into the folder `scratch`. Raises SpecError if it cannot be read."""
    log(f"reading {path.name}")
    scene = ImportedScene()
    file = _read_file(path, scene.changes)
    parts = list(_make_meshes(file, read_libraries(path, file.libraries, scene.changes)))
    bsdfs: dict[_Look, tuple[str, Element | None]] = {}  # id of the material, and emitter
    for _, look, _ in parts:
        if look not in bsdfs:
            material_id = scene.ids.make(look.material.name, "material")
            material = replace(look.material, painted=look.painted, mirrored=look.mirrored)
            light = material.put(SubElement(scene.root, "bsdf", id=material_id), scratch / material_id)
            bsdfs[look] = material_id, light
    for owner, look, mesh in parts:
        shape_id = scene.ids.make("_".join(filter(None, (owner or path.stem, look.material.name))))
        scene.put_shape(shape_id, mesh, bsdfs[look][0], owner, bsdfs[look][1], both_sides=True)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no faces{' with an area' if parts else ''}; nothing can be rendered")
    return scene


@dataclass(slots=True)
class _File:
    """The statements of a file, by what they make."""

    path: Path
    changes: Changes
    tables: dict[str, array[float]] = field(default_factory=lambda: {word: array("d") for word in _WIDTHS})
    corners: array[int] = field(default_factory=lambda: array("q"))  # (K, 3) v, vt and vn as stated, 0 for none
    faces: array[int] = field(default_factory=lambda: array("q"))
    """(N, 7) line, part, smoothing group, number of corners; how many v, vt and vn stand before the face."""
    parts: dict[tuple[str, str, str], int] = field(default_factory=dict)  # numbers of (object, group, material)
    libraries: list[str] = field(default_factory=list)
    uses: dict[str, int] = field(default_factory=dict)  # the first line of each material

    def add_row(self, line: int, word: str, texts: list[str]) -> None:
        """Add the numbers of a v, vt or vn."""
        place, width = f"line {line}", _WIDTHS[word]
        try:
            row = [float(text.partition("(")[0]) for text in texts]  # some write −nan(ind)
        except ValueError as error:
            bad = str(error).rpartition(" ")[2]
            raise SpecError(f"{self.path}: {place}: {word} has {bad}, which is no number") from error
        if word == "v" and (len(row) < 3 or not math.isfinite(sum(row[:3]))):
            raise SpecError(f"{self.path}: {place}: v has no three finite numbers")
        if word == "v" and len(row) not in (3, 4, 6) and row[6:] != [1]:  # 1 is a weight, or an alpha
            self.changes.lose("colour", "v", "numbers after x y z, or x y z r g b, are left out", place)
        self.tables[word].extend((row + [0.0 if word == "vt" else math.nan] * width)[:width])

    def add_face(self, line: int, texts: list[str], part: int, smooth: int) -> None:
        """Add a face, each corner a text v, v/vt, v//vn or v/vt/vn, to a part and a smoothing group."""
        try:
            for corner in texts:
                v, _, others = corner.partition("/")
                vt, _, vn = others.partition("/")
                self.corners.extend((int(v), int(vt or 0), int(vn or 0)))
        except (ValueError, OverflowError) as error:
            raise SpecError(f"{self.path}: line {line}: f has a corner that is none of v/vt/vn") from error
        before = (len(self.tables[word]) // width for word, width in _WIDTHS.items())
        self.faces.extend((line, part, smooth, len(texts), *before))

    def find_rows(self, faces: _Ints) -> _Ints:
        """The rows of v, vt and vn (K, 3) that corners name, −1 for none, given the face of each corner (K, 7)."""
        named = np.array(self.corners, np.int64).reshape(-1, 3)
        index = np.where(named < 0, faces[:, 4:] + named, named - 1)  # below 0 it counts back from the face
        there = [len(self.tables[word]) // width for word, width in _WIDTHS.items()]
        wrong = ((index < 0) | (index >= there)) & ((named != 0) | (np.arange(3) == 0))  # 0 is none, but of v wrong
        for bad, kind in np.argwhere(wrong)[:1]:
            fault = f"f names {list(_WIDTHS)[kind]} {named[bad, kind]}, and there are {there[kind]}, counted from 1"
            raise SpecError(f"{self.path}: line {faces[bad, 0]}: {fault}")
        return index


def _read_file(path: Path, changes: Changes) -> _File:
    """Read all statements; what of them is not carried over is said."""
    file = _File(path, changes)
    state, smoothing = {"o": "", "g": "", "usemtl": "", "s": ""}, {"": 0, "off": 0, "0": 0}
    part = smooth = file.parts.setdefault(("", "", ""), 0)
    for line, word, rest in statements(path):
        if word in file.tables:
            file.add_row(line, word, rest.partition("#")[0].split())
        elif word in {"f", "fo"}:
            file.add_face(line, rest.partition("#")[0].split(), part, smooth)
        elif word in state:
            state[word] = rest
            part = file.parts.setdefault((state["o"], state["g"], state["usemtl"]), len(file.parts))
            smooth = smoothing.setdefault(state["s"].lower(), len(smoothing))
            file.uses.setdefault(state["usemtl"], line)
        elif word == "mtllib":
            file.libraries.append(rest)
        elif word == "#MRGB":
            if rest.strip("fF"):  # which is plain white
                changes.lose("colour", word, "ZBrush's colours of vertices are not read; export as glTF")
        elif word in _NO_SURFACE.split():
            changes.note("has no surface, and is left out", f"line {line}", name=word)
        else:
            changes.lose("geometry", word, "is not read of OBJ, and is left out", f"line {line}")
    return file


def _make_meshes(file: _File, materials: dict[str, Material]) -> Iterator[tuple[str, _Look, Mesh]]:
    """Meshes with their owners, objects or else groups; faces on which a normal map lies mirrored are another mesh."""
    corner, part, tables = _triangulate(file)
    owner_at = 0 if any(o for o, _, _ in file.parts) else 1
    names = [(name[owner_at], name[2]) for name in file.parts]
    for name in sorted({names[at][1] for at in np.unique(part)} - set(materials)):
        materials[name] = Material(name, file.path, file.changes)
        if name:
            meaning = "materials are in no material file, and their surfaces are grey"
            file.changes.lose("colour", "usemtl", meaning, f"{name!r}, line {file.uses[name]}")
    has_relief = np.array([name in materials and materials[name].relief != "" for _, name in names])
    a, b, c = tables[1][corner[..., 1]].swapaxes(0, 1)
    mirrored = has_relief[part] & ((b - a)[:, 0] * (c - a)[:, 1] > (b - a)[:, 1] * (c - a)[:, 0])  # as v is downwards
    distinct = {name: number for number, name in enumerate(sorted(set(names)))}
    # An even number for each mesh, and the odd one after it for what is mirrored of it
    kind = 2 * np.array([distinct[name] for name in names])[part] + mirrored
    order = np.argsort(kind, kind="stable")
    for chosen in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else ():
        number, is_mirrored = divmod(int(kind[chosen[0]]), 2)
        owner, name = list(distinct)[number]
        mesh = _make_mesh(corner[chosen].reshape(-1, 3), tables, materials[name])
        yield owner, _Look(materials[name], "vertex_color" in mesh.attributes, bool(is_mirrored)), mesh


def _triangulate(file: _File) -> tuple[_Ints, _Ints, _Tables]:
    """The rows of the tables (v, vt, vn) at the corners of triangles (T, 3, 3), their parts (T,), and the tables."""
    faces = np.array(file.faces, np.int64).reshape(-1, 7)
    line, part, group, sizes = faces[:, :4].T
    points, uv, normals = (np.array(file.tables[word]).reshape(-1, width) for word, width in _WIDTHS.items())
    corner = file.find_rows(np.repeat(faces, sizes, axis=0))
    triangle, face, scaled_normals, crossing = _cut_polygons(points[corner[:, 0], :3], sizes)
    for each in line[crossing]:
        meaning = "faces cross themselves or have no area, and are filled as well as can be"
        file.changes.note(meaning, f"line {each}", name="f")
    for each in line[sizes < 3]:
        file.changes.note("faces have fewer than three corners, and so no surface", f"line {each}", name="f")
    made = _add_smooth_normals(corner, np.repeat(scaled_normals, sizes, axis=0), np.repeat(group, sizes), len(normals))
    normals = unit(np.concatenate([np.where(np.isfinite(normals), normals, np.nan), made, np.full((1, 3), np.nan)]))
    uv = np.concatenate([uv * (1, -1) + (0, 1), np.full((1, 2), np.nan)])
    points[:, 3:] = _read_colours(points[:, 3:], file.changes)
    return corner[triangle], part[face], (points, uv, normals)


def _cut_polygons(points: Floats, sizes: _Ints) -> tuple[_Ints, _Ints, Floats, _Ints]:
    """Cut polygons of `sizes` corners each (N,), whose points (K, 3) follow one another, into triangles.

    Returns triangles' corners (T, 3), the polygon of each (T,), polygons' normals as long as twice their areas (N, 3),
    by Newell's formula, and which polygons cross themselves or have no area. Below three corners there is no triangle.
    """
    starts, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    owner = np.repeat(np.arange(len(sizes)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    # A fan about the first corner does for convex polygons; where a triangle of it turns over, the polygon is not one
    fan = starts[owner, None] + np.stack([0 * number, number + 1, number + 2], axis=1)
    a, b, c = points[fan].swapaxes(0, 1)
    crosses, scaled_normals = np.cross(b - a, c - a), np.zeros((len(sizes), 3))
    np.add.at(scaled_normals, owner, crosses)
    bent = np.unique(owner[((crosses * scaled_normals[owner]).sum(axis=1) <= 0) & (counts[owner] > 1)])
    cuts = [starts[n] + _clip_ears(points[starts[n] : starts[n] + sizes[n]], scaled_normals[n]) for n in bent]
    convex = ~np.isin(owner, bent)
    corner = np.concatenate([fan[convex], *cuts])
    owner = np.concatenate([owner[convex], np.repeat(bent, [len(cut) for cut in cuts])])
    a, b, c = points[corner].swapaxes(0, 1)
    areas = (np.cross(b - a, c - a) * scaled_normals[owner]).sum(axis=1)  # times that of the polygon, as `whole`
    corner[areas < 0] = corner[areas < 0, ::-1]  # to face as the polygon does
    filled, whole = np.bincount(owner, np.abs(areas), len(sizes)), (scaled_normals**2).sum(axis=1)
    return corner, owner, scaled_normals, np.flatnonzero((np.abs(filled - whole) >= _ROUNDING * whole) & (sizes > 3))


def _clip_ears(points: Floats, normal: Floats) -> _Ints:
    """Cut a polygon that is not convex into triangles, or into its fan if that fails."""
    flat = np.ascontiguousarray(np.delete(points - points[0], np.abs(normal).argmax(), axis=1))  # seen along an axis
    made = triangulate_float64(flat, np.array([len(points)], np.uint32)).reshape(-1, 3)
    return np.array(made if len(made) else [[0, k, k + 1] for k in range(1, len(points) - 1)], np.int64)


def _add_smooth_normals(corner: _Ints, scaled_normals: Floats, group: _Ints, count: int) -> Floats:
    """Make normals for those corners (K, 3) of smoothing groups (K,) that have none.

    Returns them, and changes `corner`, which then names them as rows from `count` on. Each is the sum of the normals
    (K, 3), as long as twice the areas, of the polygons of a group that meet at a vertex.
    """
    smooth = (corner[:, 2] < 0) & (group > 0)
    keys = corner[smooth, 0] * (group.max(initial=0) + 1) + group[smooth]  # a number for each pair of vertex and group
    distinct, which = np.unique(keys, return_inverse=True)
    sums: Floats = np.zeros((len(distinct), 3))
    np.add.at(sums, which, scaled_normals[smooth])
    corner[smooth, 2] = count + which
    return sums


def _read_colours(given: Floats, changes: Changes) -> Floats:
    """Linear colours of vertices, NaN for those that have none, from what stands after their coordinates."""
    given = np.where(np.isfinite(given).all(axis=1, keepdims=True), given, np.nan)
    if (given > 2).any() and not np.nansum(given % 1):
        changes.note("colours of vertices are whole numbers beyond 1, and are taken for 0 to 255", name="v")
        given = given / 255
    elif (given > 1.001).any():  # more than rounding
        changes.lose("colour", "v", "colours of vertices go beyond 1, and are cut")
    return images.linear(given.clip(0, 1).astype(np.float32)).astype(np.float64)


def _make_mesh(corner: _Ints, tables: _Tables, material: Material) -> Mesh:
    """The mesh of triangles whose corners (3·T, 3) name rows of the tables."""
    points, uvs, normals = tables
    # A vertex of a mesh is a triple (v, vt, vn): pairs (vt, vn) get numbers first, so that no product overflows
    _, pair = np.unique(corner[:, 1] * (len(normals) + 1) + corner[:, 2], return_inverse=True)
    _, first, which = np.unique(corner[:, 0] * (pair.max() + 1) + pair, return_index=True, return_inverse=True)
    v, vt, vn = corner[first].T
    placed = np.isfinite(uvs[vt].sum(axis=1, keepdims=True))
    if material.has_images and not placed[vt >= 0].all():
        material.say("colour", "vt", "is no number on some faces, and images lie wrongly there")
    if material.has_images and (vt < 0).any():
        material.say(None, "vt", "some faces have none, and show one point of the images")
    return Mesh(
        points[v, :3],
        which.reshape(-1, 3).astype(np.uint32),
        normals[vn] if (vn >= 0).any() else None,
        np.where(placed, uvs[vt], (0.0, 1.0)) if material.has_images or placed.any() else None,
        _paint(points[v, 3:], material),
    )


def _paint(colours: Floats, material: Material) -> dict[str, Floats]:
    """The colours of a mesh's vertices, if it has some, and its material no image."""
    if not np.isfinite(colours).any():
        return {}
    if material.image("map_kd") is not None:
        material.say(None, "v", "colours of vertices are left out beside the image")
        return {}
    if not np.isfinite(colours).all():
        material.say(None, "v", "some vertices have no colour, and are white")
    return {"vertex_color": np.nan_to_num(colours, nan=1) * material.cut("kd", WHITE, black_is_white=True)}
