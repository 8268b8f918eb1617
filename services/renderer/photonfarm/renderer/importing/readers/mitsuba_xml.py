"""Mitsuba's XML, of versions 0.6 to 3: one file, in the terms of Mitsuba 3, without what photonfarm cannot render."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import listed
from photonfarm.renderer.importing.imported import Ids, ImportedScene, Vector
from photonfarm.renderer.importing.readers import mitsuba_instances, mitsuba_old, mitsuba_parts
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log
from photonfarm.shared.scene.located_xml import Located, line_of, parse

INCLUDES = 15
"""The deepest nesting of files that is followed; more is a file that includes itself."""

_IGNORED = ("integrator", "sensor", "film", "sampler", "default", "alias")
"""What photonfarm has settings of its own for, and what is used up by reading."""

_OF_FILES = ("bitmap", "envmap", "obj", "ply", "serialized")
"""The plugins that are nothing without a file; Mitsuba crashes on a bitmap that names none."""

_GENERATED = re.compile(r"^(_unnamed_\d+|_arg_\d+|)$")


def read(path: Path, _: Path, log: Log) -> ImportedScene:
    """Read a scene; raises SpecError for what is no scene, and for files that are not there."""
    log(f"reading {path.name}")
    root = _parsed(path)
    _put_values(root, path)
    _join(root, path, path.parent, 0)
    notes: list[str] = []
    if _version(root) < (2,):
        try:
            notes += mitsuba_old.upgrade(root)
        except ValueError as error:
            raise SpecError(f"{path}: {error}") from error
    root.set("version", "3.0.0")
    camera, up = _camera(root)
    _drop_ignored(root)
    notes += mitsuba_parts.mend(root)
    notes += mitsuba_instances.expand(root)
    _find_files(root, path)
    notes += _name_shapes(root)
    if root.find("shape") is None:
        raise SpecError(f"{path}: has no shape that photonfarm can render")
    scene = ImportedScene(root, up=up, camera=camera)
    for note in notes:
        scene.changes.note(note)
    return scene


def _parsed(path: Path) -> Located:
    try:
        root = parse(path)
    except (OSError, ParseError) as error:
        raise SpecError(f"{path}: is not a readable Mitsuba scene file: {error}") from error
    if root.tag != "scene":
        raise SpecError(f"{path}: begins with <{root.tag}>; a Mitsuba scene begins with <scene>")
    return root


def _version(root: Element) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", root.get("version", "3")))[:2]


def _put_values(root: Element, path: Path) -> None:
    """Put the values of `<default>` where their names stand."""
    values = {node.get("name", ""): node.get("value", "") for node in root.iter("default")}
    names = sorted(values, key=len, reverse=True)  # $max_depth before $max
    for node in root.iter():
        for key, text in node.attrib.items():
            for name in names if "$" in text else ():
                text = text.replace(f"${name}", values[name])
            if text.startswith("$"):
                raise SpecError(f"{path}: line {line_of(node)}: {text} has no <default>; add one, or put a value there")
            node.set(key, text)


def _join(root: Element, path: Path, folder: Path, depth: int) -> None:
    """Put the content of `<include>` files where they are named."""
    for include in root.findall("include"):
        name = include.get("filename") or ""
        file = folder / name
        line = line_of(include)
        if not file.is_file():
            raise SpecError(f"{path}: line {line}: included file {name!r} is not there")
        if depth == INCLUDES:
            raise SpecError(f"{path}: line {line}: {name!r} is included more than {INCLUDES} files deep")
        included = _parsed(file)
        _put_values(included, file)
        _join(included, file, folder, depth + 1)
        place = list(root).index(include)
        root.remove(include)
        for node in reversed(included):
            root.insert(place, node)


def _drop_ignored(root: Element) -> None:
    for node in list(root):
        if node.tag in _IGNORED:
            root.remove(node)


def _find_files(root: Element, path: Path) -> None:
    """Make the names of files absolute; raises SpecError for one that is not there, or not named where it must be."""
    for node in root.iter():
        if node.get("type") in _OF_FILES and elements.child(node, "filename") is None:
            raise SpecError(f"{path}: {elements.place(node)} of type {node.get('type')!r} has no filename; add one")
    for node, key in elements.file_names(root):
        name = node.get(key, "")
        file = (path.parent / name.replace("\\", "/")).resolve()
        if not file.is_file():
            raise SpecError(
                f"{path}: line {line_of(node)}: file {name!r} is not there; put it there, or take its place out"
            )
        node.set(key, str(file))


def _camera(root: Element) -> tuple[Vector | None, Vector]:
    """The position of the camera, and the world axis that is nearest to its up direction."""
    sensor = root.find("sensor")
    placed = None if sensor is None else elements.child(sensor, "to_world")
    if placed is None:
        return None, (0.0, 1.0, 0.0)
    import mitsuba as mi
    import numpy as np

    alone = elements.scene()
    holder = Element("sensor", type="perspective")
    holder.append(placed)
    alone.append(holder)
    try:
        camera = mi.load_string(elements.text(alone)).sensors()[0]
    except RuntimeError:
        return None, (0.0, 1.0, 0.0)
    matrix = np.array(camera.world_transform().matrix, np.float64).reshape(4, 4)
    up = np.zeros(3)
    axis = int(np.argmax(np.abs(matrix[:3, 1])))
    up[axis] = np.sign(matrix[axis, 1])
    x, y, z = matrix[:3, 3]
    return (float(x), float(y), float(z)), (float(up[0]), float(up[1]), float(up[2]))


def _name_shapes(root: Element) -> list[str]:
    """Give ids to shapes without one, by material and order; what the user reads about it."""
    ids = Ids()
    shapes = root.findall("shape")
    for node in root.iter():
        if node.tag not in ("shape", "ref") and node.get("id"):
            ids.keep(node.get("id", ""))
    unnamed = [shape for shape in shapes if _is_unnamed(shape) or not ids.keep(shape.get("id", ""))]
    for shape in unnamed:
        shape.set("id", ids.make(_material(shape), "shape"))
    if not unnamed:
        return []
    made = listed([shape.get("id", "") for shape in unnamed])
    return [f"{len(unnamed)} of {len(shapes)} shapes had no id of their own, and got one by material and order: {made}"]


def _is_unnamed(shape: Element) -> bool:
    return _GENERATED.match(shape.get("id", "")) is not None


def _material(shape: Element) -> str:
    """The name of a shape's material, or else of its file."""
    for node in shape:
        if node.tag in ("ref", "bsdf") and node.get("id") and not _GENERATED.match(node.get("id", "")):
            name = node.get("id", "")
            return re.sub(r"[_-]?(bsdf|material|mat)$", "", name, flags=re.IGNORECASE) or name
    file = elements.child(shape, "filename")
    return Path(file.get("value", "")).stem if file is not None else shape.get("type", "")
