"""Mitsuba's XML, of versions 0.6 to 3: one file, in the terms of Mitsuba 3, without what photonfarm cannot render."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError
from xml.sax.saxutils import quoteattr

import numpy as np

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import Changes, name_some
from photonfarm.renderer.tools.importing.imported import Ids, ImportedScene, Vector
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

_AROUND = ("constant", "envmap", "sunsky", "timed_sunsky")
"""The emitters that light a scene from all around."""

_HERE = {"integrator": "all light is computed here", "sensor": "cameras are perspective here"}

_USUAL = (
    "perspective",
    "path",
    "bdpt",
    "volpath",
    "volpathmis",
    "mlt",
    "pssmlt",
    "erpt",
    "ptracer",
    "photonmapper",
    "ppm",
    "sppm",
    "vpl",
    "adaptive",
    "irrcache",
    "prb",
    "prb_basic",
)
"""The cameras and integrators that mean the same picture as photonfarm's own."""


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a scene; raises SpecError for what is no scene, and for files that are not there."""
    log(f"reading {path.name}")
    scene = ImportedScene()
    files = _Files(mitsuba_old.Upgrade(scene.changes, scene.names, scratch))
    scene.root = _elements(files.parse(path), files)
    if scene.root.tag != "scene":
        raise SpecError(f"{path}: begins with <{scene.root.tag}>; a Mitsuba scene begins with <scene>")
    scene.root.set("version", "3.0.0")
    scene.camera, scene.up = _camera(scene.root)
    _drop_settings(scene.root, scene.changes)
    mitsuba_parts.mend(scene.root, scene.changes)
    _want_one_environment(scene.root)
    _find_files(scene.root, files)
    mitsuba_parts.expand(scene.root, scene.changes, scratch)
    _name_shapes(scene)
    if scene.root.find("shape") is None:
        raise SpecError(f"{path}: has no shape that photonfarm can render")
    return scene


@dataclass(slots=True)
class _Files:
    """What is read of a scene, and how."""

    upgrade: mitsuba_old.Upgrade
    resolver: Any = None  # Mitsuba's search path, as it is at the end of the scene's first file
    originals: dict[str, Path] = field(default_factory=dict)  # of the copies
    values: dict[str, str] = field(default_factory=dict)  # of <default>, for the names of included files

    def parse(self, path: Path) -> Any:
        """Mitsuba's nodes of a scene; raises SpecError, with lines of the user's files, for what it cannot read."""
        import mitsuba as mi

        before = mi.file_resolver()
        self.resolver = mi.FileResolver(before)
        self.resolver.prepend(str(path.resolve().parent))
        try:
            copy = self._copy(path, self.resolver, ())
            mi.Thread.set_file_resolver(self.resolver)
            config = mi.parser.ParserConfig(mi.variant())
            state = mi.parser.parse_file(config, str(copy))
            mi.parser.transform_resolve(config, mi.parser.ParserState(state))  # raises for names of nothing
            return state
        except RuntimeError as error:
            said = self._explain(error).replace(f"{path}: ", "")
            raise SpecError(f"{path}: Mitsuba cannot read it: {said}") from error
        finally:
            mi.Thread.set_file_resolver(before)

    def _explain(self, error: Exception) -> str:
        """What Mitsuba says, with the files and lines of the user."""
        text = re.sub(r"\[\w+\.(cpp|h):\d+\] |Error while loading ", "", " ".join(str(error).split()))
        for copy, original in self.originals.items():
            text = text.replace(copy, str(original))
        return re.sub(r" \(line (\d+), col \d+\)", r": line \1", text)

    def find(self, name: str, beside: Path) -> Path | None:
        """The file of a name, in the search path of the scene or beside the file that names it."""
        name = name.replace("\\", "/")
        places = (Path(str(self.resolver.resolve(name))), beside.parent / name)
        return next((place.resolve() for place in places if place.is_file()), None)

    def _copy(self, file: Path, resolver: Any, around: tuple[Path, ...]) -> Path:
        """A copy in the terms of Mitsuba 3, which names the copies of the files that it includes."""
        import mitsuba as mi

        try:
            root = parse(file)
        except (OSError, ParseError) as error:
            raise SpecError(f"{file}: is not a readable Mitsuba scene file: {error}") from error
        for node in root.iter():
            vars(node)["file"] = str(file)
            node.attrib.update({key: self._fill(text) for key, text in node.attrib.items() if "$" in text})
            if node.tag == "default":
                self.values.setdefault(node.get("name", ""), node.get("value", ""))
            elif node.tag == "path":
                node.set("value", str(resolver.resolve(node.get("value", ""))))
                resolver.prepend(node.get("value", ""))
            elif (included := Path(str(resolver.resolve(node.get("filename", "/"))))).is_file():
                if node.tag == "include":
                    if included in (*around, file):
                        raise SpecError(f"{file}: line {line_of(node)}: {included} includes itself; take this line out")
                    inner = mi.FileResolver(resolver)
                    inner.prepend(str(included.parent))
                    included = self._copy(included, inner, (*around, file))
                node.set("filename", str(included.resolve()))
        version = tuple(int(part) for part in re.findall(r"\d+", root.get("version", "3")))[:2]
        if version < OLDEST:
            raise SpecError(f"{file}: is of Mitsuba {root.get('version')}; open it in Mitsuba 0.6, and save it there")
        if version < MITSUBA_2:
            self.upgrade.run(root, lambda name: self.find(name, file))
        copy = self.upgrade.scratch / f"{len(self.originals)}-{file.name}"
        copy.write_text(_text(root), encoding="utf-8")
        self.originals[str(copy)] = file
        return copy

    def _fill(self, text: str) -> str:
        for name in sorted(self.values, key=len, reverse=True):  # $max_depth before $max, as Mitsuba does
            text = re.sub(rf"(?<!\\)\${re.escape(name)}", self.values[name].replace("\\", r"\\"), text)
        return text


def _text(root: Element) -> str:
    """A document whose elements begin in the lines that they know, so that what Mitsuba says holds for the original."""
    out: list[str] = []
    line = 1

    def put(node: Element) -> None:
        nonlocal line
        gap = max(0, line_of(node) - line)
        line += gap
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in node.attrib.items())
        out.append("\n" * gap + f"<{node.tag}{attributes}>")
        for part in node:
            put(part)
        out.append(f"</{node.tag}>")

    put(root)
    return "".join(out)


def _elements(state: Any, files: _Files) -> Element:
    """The elements of Mitsuba's nodes, with their places in the user's files; transforms are matrices."""
    import mitsuba as mi

    mi.parser.write_file(state, str(files.upgrade.scratch / "whole.xml"))
    nodes, numbers, root = list(state.nodes), state.id_to_index, parse(files.upgrade.scratch / "whole.xml")
    objects = [part for part in root.iter() if part is root or (part.get("type") and part.tag != "ref")]
    copies = [Path(str(file)) for file in state.files]
    ends = [np.cumsum([len(line) + 1 for line in copy.read_bytes().split(b"\n")]) for copy in copies]
    for element, node in zip(objects, nodes, strict=True):
        line = int(np.searchsorted(ends[node.file_index], node.offset, "right")) + 1
        for part in (element, *element):
            vars(part).update(file=str(files.originals[str(copies[node.file_index])]), line=line)
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
    return root


def _want_numbers(part: Element) -> None:
    """Raise SpecError for numbers that are not finite in single precision."""
    holder = part[0] if part.tag == "transform" else part
    texts = [text for key, text in holder.items() if key != "name" and part.tag in _NUMBERS]
    for word in re.findall(r"[^\s,:]+", " ".join(texts)):
        if not abs(float(word)) <= LARGEST:
            raise SpecError(f"{elements.place(part)}: {float(word):g} is no number that can be rendered with")


def _camera(root: Element) -> tuple[Vector | None, Vector]:
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
    for node in [part for part in root if part.tag in ("integrator", "sensor", "film", "sampler")]:
        root.remove(node)
        kind = node.get("type", "")
        if any(value_of(part, "hide_emitters") == "true" for part in node.iter()):
            changes.note("lights are visible here", elements.place(node), name="hide_emitters")
        if node.tag in _HERE and kind not in _USUAL:
            changes.note(_HERE[node.tag], elements.place(node), name=kind)


def _want_one_environment(root: Element) -> None:
    """Raise SpecError for two lights all around, which Mitsuba 3 does not add."""
    lights = [elements.place(node) for node in root.findall("emitter") if node.get("type") in _AROUND]
    if len(lights) > 1:
        raise SpecError(
            f"{' and '.join(lights)} light the scene from all around, which in Mitsuba 3 one light can; keep one "
            '(a sun and a sky are one as <emitter type="sunsky"/>)'
        )


def _find_files(root: Element, files: _Files) -> None:
    """Make the names of files absolute; raises SpecError for one that is not there, or not named where it must be."""
    for node in root.iter():
        if node.get("type") in _OF_FILES and elements.child(node, "filename") is None:
            raise SpecError(f"{elements.place(node)} of type {node.get('type')!r} has no filename; add one")
    for node, key in elements.file_names(root):
        name = node.get(key, "")
        beside = getattr(node, "file", "")
        file = files.find(name, Path(beside))
        if file is None:
            raise SpecError(
                f"{beside}: line {line_of(node)}: file {name!r} is not there; put it there, or take its place out"
            )
        node.set(key, str(file))
    _want_vertices(root)


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
        if (corners >= count).any():
            bad = int((corners >= count).argmax())
            raise SpecError(
                f"{elements.place(node)}: {file}: face {bad // 3} names vertex {corners[bad]}, and it has {count}; "
                "write the mesh anew"
            )


def _name_shapes(scene: ImportedScene) -> None:
    """Give ids to shapes without one, by material and order, and say so."""
    ids, shapes = Ids(scene.root), scene.root.findall("shape")
    unnamed = [shape for shape in shapes if not shape.get("id")]
    for shape in unnamed:
        shape.set("id", ids.make(_material(shape), "shape"))
    if unnamed:
        made = name_some([shape.get("id", "") for shape in unnamed])
        count = f"{len(unnamed)} of {len(shapes)} shapes"
        scene.changes.note(f"{count} had no id of their own, and got one by material and order: {made}")


def _material(shape: Element) -> str:
    """The name of a shape's material, or else of its file."""
    name = next((node.get("id", "") for node in shape if node.tag in ("ref", "bsdf") and node.get("id")), "")
    if name:
        return re.sub(r"[_-]?(bsdf|material|mat)$", "", name, flags=re.IGNORECASE) or name
    return Path(value_of(shape, "filename")).stem or shape.get("type", "")
