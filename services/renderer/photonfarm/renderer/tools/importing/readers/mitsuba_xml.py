"""Mitsuba's XML, of versions 0.4 to 3: one file, in the terms of Mitsuba 3, without what photonfarm cannot render."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import Changes, name_some
from photonfarm.renderer.tools.importing.imported import Ids, ImportedScene, Vector
from photonfarm.renderer.tools.importing.loading import parse_elements
from photonfarm.renderer.tools.importing.readers import mitsuba_old, mitsuba_parts
from photonfarm.renderer.tools.importing.readers.mitsuba_old import value_of
from photonfarm.scene.files import line_of, parse

OLDEST, MITSUBA_2 = (0, 4), (2,)
"""The oldest version that is read, and the first one that Mitsuba 3 reads as it is."""

_NUMBERS = ("float", "rgb", "vector", "spectrum", "transform")
"""The elements that hold numbers."""

LARGEST = float(np.finfo(np.float32).max)
"""The largest number that Mitsuba renders with."""

_OF_FILES = ("bitmap", "envmap", "obj", "ply", "serialized")
"""The plugins that are nothing without a file; Mitsuba crashes on a bitmap that names none."""

_USUAL = re.compile(
    "perspective|path|bdpt|volpath|volpathmis|mlt|pssmlt|erpt|ptracer|photonmapper|ppm|sppm|vpl|adaptive|irrcache|prb|"
    "prb_basic"
)
"""The cameras and integrators that mean the same picture as photonfarm's own."""


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a scene; raises SpecError for what is no scene, and for files that are not there."""
    log(f"reading {path.name}")
    scene = ImportedScene()
    files = _Files(mitsuba_old.Upgrade(scene.changes, scene.names), [path.resolve().parent])
    root = files.read(path, ())
    if root.tag != "scene":
        raise SpecError(f"{path}: begins with <{root.tag}>; a Mitsuba scene begins with <scene>")
    scene.root = _resolve_names(root, scratch / "whole.xml")
    scene.camera, scene.up = _find_camera(scene.root)
    _drop_settings(scene.root, scene.changes)
    mitsuba_parts.mend(scene.root, scene.changes)
    for node in scene.root.iter():
        if node.get("type") in _OF_FILES and elements.child(node, "filename") is None:
            raise SpecError(f"{elements.place(node)} of type {node.get('type')!r} has no filename; add one")
    for node, key in elements.file_names(scene.root):
        node.set(key, str(files.find(node, key)))
    _want_vertices(scene.root)
    mitsuba_parts.expand(scene.root, scene.changes)
    _name_shapes(scene)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no shape that photonfarm can render")
    return scene


@dataclass(slots=True)
class _Files:
    """Where files of a scene are looked for, and what its names stand for."""

    upgrade: mitsuba_old.Upgrade
    folders: list[Path]
    values: dict[str, str] = field(default_factory=dict)  # of <default>, which holds for included files, too

    def read(self, file: Path, around: tuple[Path, ...]) -> Element:
        """The elements of a file in the terms of Mitsuba 3, and of those that it includes in their places."""
        try:
            root = parse(file)
        except (OSError, ParseError) as error:
            raise SpecError(f"{file}: is not a readable Mitsuba scene file: {error}") from error
        included: dict[Element, list[Element]] = {}
        for node in root.iter():
            node.file, node.text, node.tail = str(file), None, None  # type: ignore[attr-defined]
            node.attrib.update({key: self._fill(text) for key, text in node.attrib.items() if "$" in text})
            if node.tag == "default":
                self.values.setdefault(node.get("name", ""), node.get("value", ""))
            elif node.tag == "path":
                self.folders.insert(0, next(p for f in self.folders if (p := f / node.get("value", "")).is_dir()))
            elif node.tag == "include":
                included[node] = self._include(self.find(node, "filename"), (*around, file), node)
            elif node.tag == "spectrum" and node.get("filename"):
                node.set("filename", str(self.find(node, "filename")))
        version = tuple(int(part) for part in re.findall(r"\d+", root.get("version", "3")))[:2]
        if version < OLDEST:
            raise SpecError(f"{file}: is of Mitsuba {root.get('version')}; open it in Mitsuba 0.6, and save it there")
        if version < MITSUBA_2:
            self.upgrade.run(root)
        for node in list(root.iter()):
            node[:] = [each for part in node for each in included.get(part, [part] * (part.tag not in _RESOLVED))]
        return root

    def find(self, node: Element, key: str) -> Path:
        """The file that an element names, in the scene's search path or beside the file that it is in."""
        name, file = node.get(key, "").replace("\\", "/"), Path(getattr(node, "file", ""))
        for folder in (*self.folders, file.parent):
            if (folder / name).is_file():
                return (folder / name).resolve()
        raise SpecError(
            f"{file}: line {line_of(node)}: file {name!r} is not there; put it there, or take its place out"
        )

    def _include(self, file: Path, around: tuple[Path, ...], node: Element) -> list[Element]:
        if file in [each.resolve() for each in around]:
            raise SpecError(f"{around[-1]}: line {line_of(node)}: {file} includes itself; take this line out")
        root = self.read(file, around)
        root.attrib.pop("version", None)
        return list(root) if root.tag == "scene" else [root]

    def _fill(self, text: str) -> str:
        for name in sorted(self.values, key=len, reverse=True):  # $max_depth before $max, as Mitsuba does
            text = re.sub(rf"(?<!\\)\${re.escape(name)}", self.values[name].replace("\\", r"\\"), text)
        return text


_RESOLVED = ("default", "path")
"""The elements that are gone once names are filled in."""


def _resolve_names(root: Element, scratch: Path) -> Element:
    """The same elements as Mitsuba understands them: without aliases and default values, transforms as matrices.

    Raises SpecError for names of nothing, and for numbers that single precision has not.
    """
    import mitsuba as mi

    root.set("version", "3.0.0")
    parsed = parse_elements(root)
    mi.parser.write_file(parsed.state, str(scratch))
    nodes, numbers, resolved = list(parsed.state.nodes), parsed.state.id_to_index, parse(scratch)
    objects = [part for part in resolved.iter() if part is resolved or (part.get("type") and part.tag != "ref")]
    for element, node in zip(objects, nodes, strict=True):
        origin = parsed.element_of(node)
        for part in (element, *element):
            vars(part).update(file=getattr(origin, "file", ""), line=line_of(origin))
        if node.props.id():
            element.set("id", node.props.id())
        for name in node.props:
            value = node.props[name]
            if node.props.type(name).name == "Transform" and not np.isfinite(np.array(value.matrix)).all():
                raise SpecError(f"{elements.place(element)}: {name} has a number that is none")
        for part in element:
            if part.get("name", "").startswith("_arg_"):
                del part.attrib["name"]
            if part.tag == "ref":  # by its own name or by an alias
                part.set("id", nodes[numbers[part.get("id", "")]].props.id())
            elif part.tag == "transform":
                matrix = np.array(node.props[part.get("name", "")].matrix)
                part[:] = [Element("matrix", value=" ".join(f"{each:.17g}" for each in matrix.ravel()))]
            _want_numbers(part)
    return resolved


def _want_numbers(part: Element) -> None:
    """Raise SpecError for numbers that are not finite in single precision."""
    holder = part[0] if part.tag == "transform" else part
    texts = [text for key, text in holder.items() if key != "name" and part.tag in _NUMBERS]
    for word in re.findall(r"[^\s,:]+", " ".join(texts)):
        if not abs(float(word)) <= LARGEST:
            raise SpecError(
                f"{elements.place(part)}: {float(word):g} is no number that can be rendered with; write a finite one"
            )


def _find_camera(root: Element) -> tuple[Vector | None, Vector]:
    """The position of the camera, and the world axis that is nearest to its up direction."""
    sensor = root.find("sensor")
    placed = None if sensor is None else elements.child(sensor, "to_world")
    if placed is None:
        return None, (0.0, 1.0, 0.0)
    matrix = np.array(placed[0].get("value", "").split(), np.float64).reshape(4, 4)
    axis = int(np.abs(matrix[:3, 1]).argmax())
    x, y, z = np.where(np.arange(3) == axis, np.sign(matrix[axis, 1]), 0.0)
    a, b, c = matrix[:3, 3].tolist()
    return (a, b, c), (float(x), float(y), float(z))


def _drop_settings(root: Element, changes: Changes) -> None:
    """Take out what photonfarm has settings of its own for, and say what that changes."""
    said = {"integrator": "all light is computed here", "sensor": "cameras are perspective here"}
    for node in [part for part in root if part.tag in (*said, "film", "sampler")]:
        root.remove(node)
        if any(value_of(part, "hide_emitters") == "true" for part in node.iter()):
            changes.note("lights are visible here", elements.place(node), name="hide_emitters")
        if node.tag in said and not _USUAL.fullmatch(node.get("type", "")):
            changes.note(said[node.tag], elements.place(node), name=node.get("type", ""))


def _want_vertices(root: Element) -> None:
    """Raise SpecError for PLY files whose faces name vertices that are not there, of which Mitsuba crashes."""
    import mitsuba as mi

    shapes = {value_of(node, "filename"): node for node in root.iter("shape") if node.get("type") == "ply"}
    for file, node in shapes.items():
        try:
            mesh = mi.load_dict({"type": "ply", "filename": file, "face_normals": True})  # which follows no indices
        except RuntimeError:
            continue  # it is told as the scene is loaded
        corners, count = np.array(mesh.faces_buffer()), mesh.vertex_count()
        if (bad := int(corners.max(initial=0))) >= count:
            where = f"{elements.place(node)}: {file}: face {int(corners.argmax()) // 3}"
            raise SpecError(f"{where} names vertex {bad}, and it has {count}; write the mesh anew")


def _name_shapes(scene: ImportedScene) -> None:
    """Give ids to shapes without one, by the material or else the file, and order, and say so."""
    ids, shapes = Ids(scene.root), scene.root.findall("shape")
    unnamed = [shape for shape in shapes if not shape.get("id")]
    for shape in unnamed:
        material = next((node.get("id", "") for node in shape if node.tag in ("ref", "bsdf") and node.get("id")), "")
        stem = re.sub(r"[_-]?(bsdf|material|mat)$", "", material, flags=re.IGNORECASE) or material
        shape.set("id", ids.make(stem or Path(value_of(shape, "filename")).stem or shape.get("type", ""), "shape"))
    if unnamed:
        made = name_some([shape.get("id", "") for shape in unnamed])
        count = f"{len(unnamed)} of {len(shapes)} shapes"
        scene.changes.note(f"{count} had no id of their own, and got one by material and order: {made}")
