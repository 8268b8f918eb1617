"""An imported scene loaded by Mitsuba, which tells what it does not know or refuses, and mended by what is found.

Its place, normals, lights, and shapes that hold several things.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.changes import name_some
from photonfarm.renderer.tools.importing.imported import Floats, Ids, ImportedScene, Mesh, read_mesh
from photonfarm.renderer.tools.importing.readers.mitsuba_parts import effect_of

FAR = 10.0
"""A scene whose middle is farther from the origin than so many of its diagonals is moved there. Coordinates are single
precision in renderers, and the offsets of rays grow with them."""

SMALL = 0.1  # a scene whose diagonal is shorter is too small, as Mitsuba's offsets of rays are 1e-4 at least
ROUGH = 1e-3  # of its diagonal: a shape is seen to be rough if its vertices are rounded by more

_NOWHERE = ("constant", "envmap", "sunsky", "timed_sunsky", "directional", "area")
"""Lights that have no place of their own."""


def load(scene: ImportedScene, folder: Path, log: Log) -> Any:
    """The Mitsuba scene of what was imported; adds to its changes all that had to be changed.

    Raises SpecError with Mitsuba's own words, and the element, for what Mitsuba refuses.
    """
    log(f"loading {len(scene.root.findall('shape'))} shapes")
    scene.write_meshes(folder / "meshes")
    loaded = _load(scene)
    for mended in (_move_near, _make_normals_usable):
        if mended(scene, loaded):
            scene.write_meshes(folder / "meshes")
            loaded = _load(scene)
    _flatten_lights(scene, loaded)
    return loaded


class Parsed(NamedTuple):
    """Elements of a scene as Mitsuba parses them."""

    config: Any
    state: Any
    lines: list[Element]  # the element that begins or ends in each line of the document
    text: str  # which has to last as long as the state

    def element_of(self, node: Any) -> Element:
        """The element that a node of the state was made of."""
        import mitsuba as mi

        return self.lines[int(re.sub(_LINE, r"\1", mi.parser.file_location(self.state, node))) - 1]


_LINE = r"string \(line (\d+), col \d+\)"
"""How Mitsuba names an element of a document that is a string."""


def parse_elements(root: Element, *, literally: bool = False) -> Parsed:
    """Let Mitsuba parse a scene; raises SpecError for what it refuses, and for names of nothing.

    A `$` begins the name of a value, unless all is meant `literally`.
    """
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    config.unused_properties = mi.LogLevel.Debug  # they are looked for below
    config.merge_equivalent = config.merge_meshes = False
    text, nodes = elements.text(root), root.iter()
    text = text.replace("$", r"\$") if literally else text
    lines: list[Element] = []
    for line in text.splitlines():
        lines.append(lines[-1] if line.lstrip().startswith("</") else next(nodes))
    with _explain_refusals(lines):
        state = mi.parser.parse_string(config, text)
        mi.parser.transform_resolve(config, mi.parser.ParserState(state))
        return Parsed(config, state, lines, text)


@contextmanager
def _explain_refusals(lines: list[Element]) -> Iterator[None]:
    """Raise SpecError for what Mitsuba refuses, which names elements in place of lines of our document."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        said = re.sub(r"\[\w+\.(cpp|h):\d+\]|Error while loading |At (?=string)", "", str(error))
        said = re.sub(_LINE, lambda match: elements.place(lines[int(match[1]) - 1]), said)
        raise SpecError(f"Mitsuba cannot load it: {' '.join(said.split())}") from error


def _load(scene: ImportedScene) -> Any:
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    parsed = parse_elements(scene.root, literally=True)
    with _explain_refusals(parsed.lines), threads_to_read_with():
        mi.parser.transform_all(parsed.config, parsed.state)
        loaded = mi.parser.instantiate(parsed.config, parsed.state)
    above = elements.parents(scene.root)
    for node in parsed.state.nodes:
        _drop_unknown(scene, parsed.element_of(node), node.props.unqueried(), above)
    return loaded


def _drop_unknown(scene: ImportedScene, node: Element, names: list[str], above: dict[Element, Element]) -> None:
    """Take out the properties that no plugin asked for: they changed nothing, and are said."""
    unnamed = [part for part in node if part.get("name") is None]  # Mitsuba numbers these
    parts = {f"_arg_{number}": part for number, part in enumerate(unnamed)}
    parts |= {part.get("name", ""): part for part in node if part not in unnamed}
    for name in names:
        node.remove(parts[name])
        said = scene.names.get(name, name) if parts[name] not in unnamed else parts[name].tag
        meaning = "is not known to Mitsuba 3, and is left out"
        scene.changes.lose(effect_of(node, above), said, meaning, elements.place(node))


def _move_near(scene: ImportedScene, loaded: Any) -> bool:
    """Move a scene that is far from the origin there, its lower corner first; whether that was done.

    What readers made is in double precision and is moved so; vertices of other files are rounded already.
    """
    low, high = np.array(loaded.bbox().min, np.float64), np.array(loaded.bbox().max, np.float64)
    if scene.meshes:
        vertices = [mesh.vertices for mesh in scene.meshes.values()]
        low = np.minimum.reduce([each.min(axis=0) for each in vertices])
        high = np.maximum.reduce([each.max(axis=0) for each in vertices])
    diagonal = float(np.linalg.norm(high - low))
    if 0 < diagonal < SMALL:
        meaning = f"the scene is {diagonal:.2g} across, where rays are rough; make it larger in your program"
        scene.changes.lose("geometry", "size", meaning)
    is_far = bool(np.linalg.norm(low + high) / 2 > FAR * diagonal) and 0 < diagonal < np.inf
    _say_roughness(scene, loaded, exact=scene.meshes.keys() if is_far else ())
    if not is_far:
        return False
    step = 10.0 ** np.floor(np.log10(diagonal))
    by = 0.0 - np.floor(low / step) * step
    offset = ", ".join(f"{part:.10g}" for part in by)
    scene.changes.note(f"the scene is far from the origin, where coordinates are rough, and is moved by ({offset})")
    for shape_id, mesh in scene.meshes.items():
        scene.meshes[shape_id] = replace(mesh, vertices=mesh.vertices + by)
    for node in [*scene.root.findall("shape"), *scene.root.findall("emitter")]:
        if node.get("id") not in scene.meshes and node.get("type") not in _NOWHERE:
            _move(node, by)
    if scene.camera is not None:
        x, y, z = (np.array(scene.camera) + by).tolist()
        scene.camera = (x, y, z)
    return True


def _say_roughness(scene: ImportedScene, loaded: Any, exact: Collection[str]) -> None:
    """Say which shapes but the `exact` ones are rounded too much, where they are more than half of the surface."""
    area = {shape.id(): float(np.array(shape.surface_area()).ravel()[0]) for shape in loaded.shapes()}
    rough = {}
    for shape in loaded.shapes():
        corners = np.array([shape.bbox().min, shape.bbox().max], np.float32).reshape(2, 3)
        rounding = float(np.spacing(np.abs(corners).max()))
        if rounding > ROUGH * np.linalg.norm(corners[1] - corners[0]) and shape.id() not in exact:
            rough[shape.id()] = rounding
    for shape_id, rounding in rough.items() if 2 * sum(area[each] for each in rough) > sum(area.values()) else ():
        meaning = "vertices are rounded, as coordinates are single precision; move all of it near the origin"
        scene.changes.lose("geometry", "coordinates", meaning, f"shape {shape_id!r} by up to {rounding:.2g}")


def _move(node: Element, by: Floats) -> None:
    """Move a shape or a light, after all that moves it already."""
    place = elements.child(node, "position")
    if place is not None:
        for axis, part in zip("xyz", by, strict=True):
            place.set(axis, f"{float(place.get(axis, '0')) + part:.10g}")
        return
    if (transform := elements.child(node, "to_world")) is None:
        transform = SubElement(node, "transform", name="to_world")
    SubElement(transform, "translate", {axis: f"{part:.10g}" for axis, part in zip("xyz", by, strict=True)})


def _make_normals_usable(scene: ImportedScene, loaded: Any) -> bool:
    """Give meshes of Mitsuba's files the normals of their faces where theirs are zero or no numbers; whether any."""
    mended = False
    for shape in loaded.shapes():
        if shape.id() in scene.meshes or not shape.is_mesh() or not shape.has_vertex_normals():
            continue
        normals = np.array(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
        if not (np.abs(normals).max(axis=1, initial=0) > 0).all():  # also for NaN
            mended = True
            _replace(scene, shape.id(), {shape.id(): read_mesh(shape).usable(shape.id(), scene.changes)})
    return mended


def _flatten_lights(scene: ImportedScene, loaded: Any) -> None:
    """Give meshes that emit the normals of their faces: with others they cannot be sampled without bias."""
    from photonfarm.renderer.bdpt.lights.selection import is_flat

    lights = [shape for shape in loaded.shapes() if shape.is_emitter() and shape.is_mesh()]
    smooth = [shape.id() for shape in lights if not np.array(is_flat(shape)).all()]
    for element in scene.root.findall("shape"):
        if element.get("id") in smooth:
            element[:] = [part for part in element if part.get("name") != "face_normals"]
            elements.put_value(element, "face_normals", True)
    if smooth:
        meaning = "lights are flat here: smooth normals of their meshes are left out"
        scene.changes.note(f"{name_some(sorted(smooth))}: {meaning}")


def shapes_of_things(
    scene: ImportedScene, loaded: Any, shape_of: NDArray[np.int32], thing_of: NDArray[np.int64]
) -> list[list[str]]:
    """The ids of the shapes of each thing; shapes of several things, or of one and the room, are split in `scene`.

    `shape_of` and `thing_of` (F,) are the numbers of each face's shape and thing, which is −1 for the room.
    """
    ids = Ids(scene.root)
    owned: list[list[str]] = [[] for _ in range(int(thing_of.max(initial=-1)) + 1)]
    split = []
    for number, shape in enumerate(loaded.shapes()):
        faces = thing_of[shape_of == number]
        parts = {int(thing): shape.id() for thing in np.unique(faces)}
        if len(parts) > 1:
            split.append(shape.id())
            parts = {thing: ids.make(f"{shape.id()}_part") for thing in parts}
            mesh = read_mesh(shape)
            _replace(scene, shape.id(), {made: mesh.part(faces == thing) for thing, made in parts.items()})
        for thing, made in parts.items():
            if thing >= 0:
                owned[thing].append(made)
    if split:
        scene.changes.note(f"{name_some(split)}: held separate things in one mesh, and became a shape for each")
    return owned


def _replace(scene: ImportedScene, shape_id: str, meshes: dict[str, Mesh]) -> None:
    """Let meshes take the place of a shape, each by its id, with the shape's material and light."""
    element = next(node for node in scene.root.findall("shape") if node.get("id") == shape_id)
    kept = [node for node in element if node.tag in ("ref", "bsdf", "emitter")]
    place = list(scene.root).index(element)
    scene.root.remove(element)
    for made, mesh in meshes.items():
        if len(mesh.faces):
            flat = mesh.normals is None or element.find("emitter") is not None
            scene.meshes[made] = replace(mesh, normals=None) if flat else mesh
            new = elements.mesh_shape(elements.scene(), made, faceted=flat)
            new.extend(kept)
            scene.root.insert(place, new)
            kept = [elements.copy_element(node) for node in kept]
