"""An imported scene loaded by Mitsuba, and mended where Mitsuba refuses it: its own message says which element."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import Effect, listed
from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.mending import make_normals_usable, move_to_origin
from photonfarm.renderer.importing.readers.mitsuba_parts import make_diffuse
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log

MOST_FAULTS = 200

_LINE = re.compile(r"\(line (\d+), col \d+\)")
_UNKNOWN_PROPERTY = re.compile(r'^\s+- .+? "(.+?)"', re.MULTILINE)
_UNKNOWN_PLUGIN = re.compile(r'Plugin "(.+?)" not found')


def load(scene: ImportedScene, folder: Path, log: Log) -> Any:
    """The Mitsuba scene of what was imported; adds to its changes all that had to be changed.

    Materials and lights are tried first, as that takes no time, and then with the shapes. Raises SpecError with
    Mitsuba's own words where no change helps.
    """
    _try(_without_shapes(scene.root), scene, folder)
    log(f"loading {len(scene.root.findall('shape'))} shapes")
    scene.write_meshes(folder / "meshes")
    loaded = _try(scene.root, scene, folder)
    for mended in (move_to_origin, make_normals_usable):
        if mended(scene, loaded):
            scene.write_meshes(folder / "meshes")
            loaded = _try(scene.root, scene, folder)
    _flatten_lights(scene, loaded)
    return loaded


def _flatten_lights(scene: ImportedScene, loaded: Any) -> None:
    """Give meshes that emit the normals of their faces: with others they cannot be sampled without bias."""
    from photonfarm.renderer.bdpt.lights.selection import is_flat

    smooth = {
        shape.id()
        for shape in loaded.shapes()
        if shape.is_emitter() and shape.is_mesh() and not np.array(is_flat(shape)).all()
    }
    for element in scene.root.findall("shape"):
        if element.get("id") in smooth:
            elements.put_value(element, "face_normals", True)
    if smooth:
        scene.changes.note(f"{listed(sorted(smooth))}: emits light, and so got the normals of its faces")


def _without_shapes(root: Element) -> Element:
    """The definitions, with those inside shapes beside them; the elements are those of `root`."""
    definitions = elements.scene()
    for node in root:
        if node.tag != "shape":
            definitions.append(node)
    definitions.extend(part for shape in root.findall("shape") for part in shape.findall("bsdf"))
    return definitions


def _try(root: Element, scene: ImportedScene, folder: Path) -> Any:
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    file = folder / "try.xml"
    for _ in range(MOST_FAULTS):
        elements.write(root, file)
        try:
            with threads_to_read_with():
                return mi.load_file(str(file), optimize=False)
        except (RuntimeError, ValueError) as error:
            _mend(root, scene, str(error))
    raise SpecError(f"more than {MOST_FAULTS} parts are not known to Mitsuba 3; export the scene for Mitsuba 3 instead")


def _mend(tried: Element, scene: ImportedScene, message: str) -> None:
    """Change what Mitsuba refuses. Raises SpecError where there is nothing to change."""
    found = _LINE.search(message)
    node = _at_line(tried, int(found[1])) if found else None
    plugin = _UNKNOWN_PLUGIN.search(message)
    properties = _UNKNOWN_PROPERTY.findall(message) if "unreferenced" in message else []
    if node is None or not (plugin or properties):
        raise SpecError(f"Mitsuba cannot load the scene: {' '.join(message.split())}")
    place = elements.place(node)
    if properties:
        _drop(node, properties, message)
        for name in properties:
            scene.changes.lose("colour", name, "is not known to Mitsuba 3, and is left out", place)
        return
    kind = node.get("type", "")
    if node.tag == "bsdf":
        make_diffuse(node)
        scene.changes.lose("colour", kind, "is not in Mitsuba 3, and became diffuse", place)
        return
    for tree in (tried, scene.root):
        above = elements.parents(tree).get(node)
        if above is not None:
            above.remove(node)
    effect: Effect = "light" if node.tag == "emitter" else "geometry" if node.tag == "shape" else "colour"
    scene.changes.lose(effect, kind, "is not in Mitsuba 3, and is left out", place)


def _drop(node: Element, properties: list[str], message: str) -> None:
    before = len(node)
    for part in list(node):
        if part.get("name") in properties:
            node.remove(part)
    if len(node) == before:  # a part without a name, which Mitsuba numbers
        unnamed = [part for part in node if part.get("name") is None]
        numbers = [int(name.removeprefix("_arg_")) for name in properties if name.startswith("_arg_")]
        if not numbers or max(numbers) >= len(unnamed):
            raise SpecError(f"Mitsuba cannot load the scene: {' '.join(message.split())}")
        for number in numbers:
            node.remove(unnamed[number])


def _at_line(root: Element, line: int) -> Element | None:
    """The element that a written document has in a line: it has one a line, and the ends of those with parts."""
    number = 0
    found: Element | None = None

    def visit(node: Element) -> None:
        nonlocal number, found
        number += 1
        if number == line:
            found = node
        for part in node:
            visit(part)
        number += len(node) > 0

    visit(root)
    return found
