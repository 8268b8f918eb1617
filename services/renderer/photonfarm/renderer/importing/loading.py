"""An imported scene loaded by Mitsuba: what it does not know is taken out, and what it refuses is told."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.changes import listed
from photonfarm.renderer.importing.imported import ImportedScene
from photonfarm.renderer.importing.mending import fit, make_normals_usable
from photonfarm.renderer.importing.readers.mitsuba_parts import effect_of
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.waiting import Log


def load(scene: ImportedScene, folder: Path, log: Log) -> Any:
    """The Mitsuba scene of what was imported; adds to its changes all that had to be changed.

    Raises SpecError with Mitsuba's own words, and the element, for what Mitsuba refuses.
    """
    log(f"loading {len(scene.root.findall('shape'))} shapes")
    scene.write_meshes(folder / "meshes")
    loaded = _loaded(scene)
    for mended in (fit, make_normals_usable):
        if mended(scene, loaded):
            scene.write_meshes(folder / "meshes")
            loaded = _loaded(scene)
    _flatten_lights(scene, loaded)
    return loaded


def _loaded(scene: ImportedScene) -> Any:
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    config = mi.parser.ParserConfig(mi.variant())
    config.unused_properties = mi.LogLevel.Debug  # they are looked for below
    config.merge_equivalent = config.merge_meshes = False
    objects = [node for node in scene.root.iter() if node.tag == "scene" or (node.get("type") and node.tag != "ref")]
    state = mi.parser.ParserState()
    try:
        text = elements.text(scene.root).replace("$", r"\$")  # which begins no name of a value here
        state = mi.parser.parse_string(config, text)
        mi.parser.transform_all(config, state)
        with threads_to_read_with():
            loaded = mi.parser.instantiate(config, state)
    except (RuntimeError, ValueError) as error:
        raise SpecError(_told(str(error), state, objects)) from error
    _drop_unknown(scene, objects, [node.props.unqueried() for node in state.nodes])
    return loaded


def _told(message: str, state: Any, objects: list[Element]) -> str:
    """What Mitsuba refuses, by the element in place of its line in our document."""
    import mitsuba as mi

    said = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\]", "", message).split())
    found = re.search(r"string \(line \d+, col \d+\)", said)
    places = [mi.parser.file_location(state, node) for node in state.nodes]
    if found is None or found[0] not in places:
        return f"Mitsuba cannot load the scene: {said}"
    place = elements.place(objects[places.index(found[0])])
    return f"{place}: Mitsuba cannot load it: {said[found.end() :].lstrip(': ')}"


def _drop_unknown(scene: ImportedScene, objects: list[Element], unknown: list[list[str]]) -> None:
    """Take out the properties that no plugin asked for: they changed nothing, and are said."""
    above = elements.parents(scene.root)
    for node, names in zip(objects, unknown, strict=True):
        unnamed = [part for part in node if part.get("name") is None]  # Mitsuba numbers these
        parts = {f"_arg_{number}": part for number, part in enumerate(unnamed)}
        parts |= {part.get("name", ""): part for part in node if part not in unnamed}
        for name in names:
            node.remove(parts[name])
            said = scene.names.get(name, name) if parts[name] not in unnamed else parts[name].tag
            scene.changes.lose(
                effect_of(node, above), said, "is not known to Mitsuba 3, and is left out", elements.place(node)
            )


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
