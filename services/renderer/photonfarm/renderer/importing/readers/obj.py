"""OBJ with MTL: statements become meshes, one for each object, or else group, and material."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.renderer.importing.changes import Changes
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Floats, Mesh, unit
from photonfarm.renderer.importing.readers import images
from photonfarm.renderer.importing.readers.mtl import WHITE, Material, Meaning, read_libraries, statements
from photonfarm.renderer.importing.readers.mtl_surfaces import Surface
from photonfarm.renderer.importing.readers.polygons import Ints, smooth_normals, triangles
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log

_OTHERS: dict[str, Meaning] = {
    **dict.fromkeys(("p", "l", "curv", "curv2", "cdc"), (None, "points and lines have no surface, and are left out")),
    **dict.fromkeys(("surf", "bsp", "bzp", "cdp"), ("geometry", "free-form surfaces are left out")),
    **dict.fromkeys(("call", "csh"), ("geometry", "what another file or program would add is missing")),
    **dict.fromkeys(("shadow_obj", "trace_obj"), ("light", "shadows and reflections are those of the shapes here")),
    **dict.fromkeys(("maplib", "usemap"), ("colour", "images beside those of materials are left out")),
    "#MRGB": ("colour", "ZBrush's colours of vertices are left out"),
}
"""What statements mean that make nothing here."""

_UNKNOWN: Meaning = ("geometry", "is no known statement of OBJ, and is left out")

_WITHOUT_EFFECT = (
    "vp cstype deg bmat step parm trim hole scrv sp end con ctech stech res mg lod bevel c_interp d_interp"
)
"""What belongs to free-form surfaces, which are said themselves, and to how quickly programs draw."""

_NO_NUMBER = re.compile(r"[+-]?(nan|\d\.#(ind|qnan|snan))", re.IGNORECASE)
"""How C libraries begin 0/0."""

_Tables = tuple[Floats, Floats, Floats, Floats | None]
"""Points, texture coordinates, normals, and colours of points, if they have some."""

_CORNER = re.compile(r"-?\d{1,18}(/(-?\d{1,18})?){0,2}")
_MISSING = ("/0/0", "/0", "")
"""What a corner lacks, by the slashes in it; 0 is no index of OBJ."""


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file; changed images are put into the folder `scratch`. Raises SpecError if it cannot be read."""
    log(f"reading {path.name}")
    scene, ids = ImportedScene(), Ids()
    file = _File(path, scene.changes)
    parts = list(_parts(file, read_libraries(path, file.libraries, scene.changes)))
    known: dict[Surface, tuple[str, Element | None]] = {}
    for _, surface, _ in parts:
        if surface not in known:
            made = ids.make(surface.material.name, "material")
            known[surface] = made, replace(surface, stem=scratch / made).put(SubElement(scene.root, "bsdf", id=made))
    for owner, surface, mesh in parts:
        shape_id = ids.make("_".join(filter(None, (owner or path.stem, surface.material.name))))
        made, light = known[surface]
        scene.put_shape(shape_id, mesh, made, owner, light, both_sides=True)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no faces{' with an area' if parts else ''}; nothing can be rendered")
    return scene


@dataclass(slots=True)
class _File:
    """The statements of a file, by what they make."""

    path: Path
    changes: Changes
    numbers: dict[str, list[str]] = field(default_factory=lambda: {"v": [], "vt": [], "vn": []})
    faces: list[str] = field(default_factory=list)
    marks: list[tuple[int, ...]] = field(default_factory=list)  # line, counts of v, vt and vn, part, smoothing group
    parts: dict[tuple[str, str, str], int] = field(default_factory=dict)  # numbers of (object, group, material)
    libraries: list[str] = field(default_factory=list)
    uses: dict[str, int] = field(default_factory=dict)  # the first line of each material

    def __post_init__(self) -> None:
        state, groups = {"o": "", "g": "", "usemtl": "", "s": ""}, {"": 0, "off": 0, "0": 0}
        part = smooth = self.parts.setdefault(("", "", ""), 0)
        v, vt, vn = self.numbers.values()
        for line, word, rest in statements(self.path):
            if word in self.numbers:
                self.numbers[word].append(rest)
            elif word in {"f", "fo"}:
                self.faces.append(rest)
                self.marks.append((line, len(v), len(vt), len(vn), part, smooth))
            elif word in state:
                state[word] = rest
                part = self.parts.setdefault((state["o"], state["g"], state["usemtl"]), len(self.parts))
                smooth = groups.setdefault(state["s"].lower(), len(groups))
                self.uses.setdefault(state["usemtl"], line)
            elif word == "mtllib":
                self.libraries.append(rest)
            elif word not in _WITHOUT_EFFECT.split() and not (word == "#MRGB" and not rest.strip("fF")):
                effect, meaning = _OTHERS.get(word, _UNKNOWN)
                self.changes.say(effect, word, meaning, f"line {line}")

    def line(self, word: str, number: int) -> str:
        """Where a statement is, by its number among those of its word."""
        lines = (line for line, found, _ in statements(self.path) if found == word)
        return f"line {next(islice(lines, number, None))}"

    def table(self, word: str) -> Floats:
        """The numbers of the statements of a word (N, 3 or more), NaN where there are none."""
        rows = [(text.partition("#")[0] if "#" in text else text).split() for text in self.numbers[word]]
        width = max(3, max(map(len, rows), default=3))
        rows = [row if len(row) == width else row + ["nan"] * (width - len(row)) for row in rows]
        try:
            values = np.array(list(chain.from_iterable(rows)), np.float64)
        except ValueError:
            values = np.array([self._number(text, word, at) for at, row in enumerate(rows) for text in row])
        return values.reshape(-1, width)

    def _number(self, text: str, word: str, at: int) -> float:
        try:
            return float("nan" if _NO_NUMBER.match(text) else text)
        except ValueError as error:
            raise SpecError(f"{self.path}: {self.line(word, at)}: {word} has {text!r}, which is no number") from error

    def corners(self) -> tuple[Ints, Ints]:
        """What the corners of all faces name of v, vt and vn, counted from 0 or −1 (K, 3); how many each face has."""
        faces = [(text.partition("#")[0] if "#" in text else text).split() for text in self.faces]
        sizes = np.array([len(face) for face in faces], np.int64)
        marks = np.repeat(np.array(self.marks, np.int64).reshape(-1, 6), sizes, axis=0)
        try:
            text = " ".join([corner + _MISSING[corner.count("/")] for corner in chain.from_iterable(faces)]) + " "
            text = text.replace("//", "/0/").replace("/ ", "/0 ").replace("/", " ")
            named = np.array(text.split(), np.int64).reshape(-1, 3)
        except (ValueError, IndexError, OverflowError) as error:
            bad = [not _CORNER.fullmatch(corner) for corner in chain.from_iterable(faces)].index(True)
            raise SpecError(f"{self.path}: line {marks[bad, 0]}: f has a corner that is none of v/vt/vn") from error
        index = np.where(named < 0, marks[:, 1:4] + named, named - 1)
        there = [len(found) for found in self.numbers.values()]
        wrong = ((index < 0) | (index >= there)) & ((named != 0) | (np.arange(3) == 0))
        for bad, kind in np.argwhere(wrong)[:1]:
            word, count = list(self.numbers)[kind], there[kind]
            fault = f"f names {word} {named[bad, kind]}, and there are {count}, counted from 1"
            raise SpecError(f"{self.path}: line {marks[bad, 0]}: {fault}")
        return index, sizes

    def points(self) -> tuple[Floats, Floats | None]:
        """Vertices (V, 3), and their linear colours, NaN where they have none."""
        table = self.table("v")
        for bad in np.flatnonzero(~np.isfinite(table[:, :3]).all(axis=1))[:1]:
            raise SpecError(f"{self.path}: {self.line('v', bad)}: v has no three finite numbers")
        colours = np.full((len(table), 3), np.nan)
        colours[:, : table.shape[1] - 3] = table[:, 3:6]
        coloured = np.isfinite(colours).all(axis=1)
        more = np.isfinite(table[:, 3:]).sum(axis=1) - 3 * coloured  # beside a colour; 1 may be a curve's weight
        for odd in np.flatnonzero((more > ~coloured) & ~(coloured & (more == 1) & (table[:, -1] == 1)))[:1]:
            meaning = "numbers after x y z, or x y z r g b, are left out"
            self.changes.lose("colour", "v", meaning, self.line("v", odd))
        if not coloured.any():
            return table[:, :3], None
        if colours[coloured].max() > 1:
            self.changes.note("colours of vertices go beyond 1, and are taken for 0 to 255", name="v")
            colours /= 255
        linear = images.linear(colours.clip(0, 1).astype(np.float32))
        return table[:, :3], np.where(coloured[:, None], linear, np.nan)

    def uv(self) -> Floats:
        """Texture coordinates (·, 2), v downwards, NaN where u is no number, and (0, 1) as the last."""
        uv = np.concatenate([self.table("vt")[:, :2], np.zeros((1, 2))])
        uv[np.isnan(uv[:, 1]), 1] = 0
        return uv * (1, -1) + (0, 1)


def _parts(file: _File, materials: dict[str, Material]) -> Iterator[tuple[str, Surface, Mesh]]:
    """The faces of a file by object, or else group, and by material; where images lie mirrored under it, apart."""
    corner, part, tables = _triangles(file)
    by = 0 if any(o for o, _, _ in file.parts) else 1
    names = [(name[by], name[2]) for name in file.parts]
    for name in sorted({names[at][1] for at in np.unique(part)} - set(materials)):
        materials[name] = Material(name, file.path, file.changes)
        if name:
            meaning = "materials are in no material file, and their surfaces are grey"
            file.changes.lose("colour", "usemtl", meaning, f"{name!r}, line {file.uses[name]}")
    mapped = np.array([name in materials and materials[name].relief != "" for _, name in names])
    a, b, c = tables[1][corner[..., 1]].swapaxes(0, 1)
    mirrored = mapped[part] & ((b - a)[:, 0] * (c - a)[:, 1] > (b - a)[:, 1] * (c - a)[:, 0])  # v is downwards
    distinct = sorted(set(names))
    number = {name: 2 * at for at, name in enumerate(distinct)}
    kind = np.array([number[name] for name in names])[part] + mirrored
    order = np.argsort(kind, kind="stable")
    for chunk in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else ():
        owner, name = distinct[kind[chunk[0]] // 2]
        mesh = _mesh(corner[chunk].reshape(-1, 3), tables, materials[name])
        yield owner, Surface(materials[name], mesh.colours is not None, bool(kind[chunk[0]] % 2)), mesh


def _triangles(file: _File) -> tuple[Ints, Ints, _Tables]:
    """The rows of tables that triangles have at their corners (T, 3, 3), their parts (T,), and the tables."""
    marks, (points, colours) = np.array(file.marks, np.int64).reshape(-1, 6), file.points()
    corner, sizes = file.corners()
    triangle, face, across, crossing = triangles(points[corner[:, 0]], sizes)
    faults = {"cross themselves or have no area, and are filled as well as can be": crossing,
              "have fewer than three corners, and so no surface": np.flatnonzero(sizes < 3)}  # fmt: skip
    for fault, faces in faults.items():
        for line in marks[faces, 0]:
            file.changes.note(f"faces {fault}", f"line {line}", name="f")
    across, group = np.repeat(across, sizes, axis=0), np.repeat(marks[:, 5], sizes)
    smooth, normals = (corner[:, 2] < 0) & (group > 0), file.table("vn")[:, :3]
    made, which = smooth_normals(corner[smooth, 0] * (group.max(initial=0) + 1) + group[smooth], across[smooth])
    corner[smooth, 2] = len(normals) + which
    normals = np.concatenate([np.where(np.isfinite(normals), normals, np.nan), made, np.full((1, 3), np.nan)])
    return corner[triangle], marks[face, 4], (points, file.uv(), unit(normals), colours)


def _mesh(corner: Ints, tables: _Tables, material: Material) -> Mesh:
    """The mesh of triangles whose corners (3 F, 3) name rows of the tables; −1 names the last, that of none."""
    points, uvs, normals, colours = tables
    _, pair = np.unique((corner[:, 1] + 1) * (len(normals) + 1) + corner[:, 2] + 1, return_inverse=True)
    _, first, which = np.unique(corner[:, 0] * (pair.max() + 1) + pair, return_index=True, return_inverse=True)
    v, vt, vn = corner[first].T
    uv, colour = uvs[vt], np.zeros(0) if colours is None else colours[v]
    if material.has_images and (vt < 0).any():
        material.say((None, "some faces have none, and show one point of the images"), "vt")
    if material.has_images and not np.isfinite(uv).all():
        material.say(("colour", "is no number on some faces, and images lie wrongly there"), "vt")
    coloured, image = np.isfinite(colour).any(), material.image("map_kd")
    if coloured and image is not None:
        material.say((None, "colours of vertices are left out beside the image"), "v")
    if coloured and image is None and not np.isfinite(colour).all():
        material.say((None, "some vertices have no colour, and are white"), "v")
    return Mesh(
        points[v],
        which.reshape(-1, 3).astype(np.uint32),
        normals[vn] if (vn >= 0).any() else None,
        np.where(np.isfinite(uv), uv, 0) if material.has_images or (vt >= 0).any() else None,
        np.nan_to_num(colour, nan=1) * material.cut("kd", WHITE) if coloured and image is None else None,
    )
