"""Elements of Mitsuba's XML, made of values and read.

Spots that fade as a profile says are made here too: Mitsuba has them by an image on a cone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.tools.importing import images
from photonfarm.scene.files import Located, line_of


def scene() -> Element:
    """An empty scene."""
    return Element("scene", version="3.0.0")


def put_value(parent: Element, name: str, value: float | bool | str | Sequence[float]) -> Element:
    """Add a property: its type follows from the value; a sequence is a colour."""
    if isinstance(value, bool):
        return SubElement(parent, "boolean", name=name, value="true" if value else "false")
    if isinstance(value, str):
        return SubElement(parent, "string", name=name, value=value)
    if isinstance(value, int):
        return SubElement(parent, "integer", name=name, value=str(value))
    if isinstance(value, float):
        return SubElement(parent, "float", name=name, value=f"{value:.7g}")
    return SubElement(parent, "rgb", name=name, value=numbers(value))


def numbers(values: Sequence[float]) -> str:
    """Numbers as Mitsuba reads them, to float32's precision."""
    return ", ".join(f"{float(value):.7g}" for value in values)


def put_bitmap(parent: Element, name: str, file: Path, *, raw: bool = False) -> Element:
    """Add a texture that is an image file; `raw` values are numbers and no colours."""
    texture = SubElement(parent, "texture", name=name, type="bitmap")
    put_value(texture, "filename", str(file))
    if raw:
        put_value(texture, "raw", True)
    return texture


def put_matrix(parent: Element, name: str, rows: Sequence[Sequence[float]]) -> None:
    """Add a transform by its 4 × 4 matrix, also one of texture coordinates."""
    transform = SubElement(parent, "transform", name=name)
    SubElement(transform, "matrix", value=" ".join(f"{float(value):.9g}" for row in rows for value in row))


def mesh_shape(parent: Element, shape_id: str, *, faceted: bool) -> Element:
    """Add a shape whose PLY file is not written yet; a `faceted` one has the normals of its faces."""
    shape = SubElement(parent, "shape", type="ply", id=shape_id)
    put_value(shape, "filename", "")
    if faceted:
        put_value(shape, "face_normals", True)
    return shape


def put_sky(scene: Element) -> None:
    """Surround a scene by white light."""
    put_value(SubElement(scene, "emitter", type="constant"), "radiance", (1.0, 1.0, 1.0))


def child(parent: Element, name: str) -> Element | None:
    """The property of this name."""
    return next((node for node in parent if node.get("name") == name), None)


def parents(root: Element) -> dict[Element, Element]:
    """The parent of each element."""
    return {node: parent for parent in root.iter() for node in parent}


def file_names(root: Element) -> Iterator[tuple[Element, str]]:
    """Each element that names a file, and the attribute that holds the name."""
    for node in root.iter():
        if node.tag == "string" and node.get("name") == "filename":
            yield node, "value"
        elif node.tag == "spectrum" and node.get("filename"):
            yield node, "filename"


def text(root: Element) -> str:
    """A document, an element a line."""
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def place(node: Element) -> str:
    """An element as a message names it, with its line where that is known."""
    line, file = line_of(node), getattr(node, "file", "")
    name = node.get("id") or node.get("name") or ""
    where = f"{Path(file).name + ': ' if file else ''}line {line}: " if line else ""
    return f"{where}<{node.tag}>{f' {name!r}' if name else ''}"


def copy_element(node: Element) -> Element:
    """A copy of an element and all in it without ids, which must be unique; references keep theirs."""
    copy = type(node)(node.tag, {key: value for key, value in node.attrib.items() if key != "id" or node.tag == "ref"})
    if isinstance(node, Located) and isinstance(copy, Located):
        copy.file, copy.line = node.file, node.line
    copy.text, copy.tail = node.text, node.tail
    copy.extend(copy_element(part) for part in node)
    return copy


def write(root: Element, file: Path) -> None:
    """Write a document."""
    file.write_text(text(root), encoding="utf-8")


Profile = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""The share of a spot's intensity at tangents (x, y) off its axis."""

WIDEST = math.radians(89.5)
"""The widest half angle of a spot, whose image is flat."""


def put_cones(spots: Sequence[Element], profile: Profile, cut: float, file: Path) -> None:
    """Let spots end at an angle and fade as a profile says, by an image that is written."""
    texels = 1024 if cut < math.radians(80) else 2048  # as tangents are large there
    y, x = np.meshgrid(*[math.tan(cut) * (2 * (np.arange(texels) + 0.5) / texels - 1)] * 2, indexing="ij")
    file = images.save(profile(x, y).astype(np.float32), file)
    for spot in spots:
        put_value(spot, "cutoff_angle", math.degrees(cut))
        put_value(spot, "beam_width", math.degrees(cut) * 0.999)
        put_value(put_bitmap(spot, "texture", file, raw=True), "wrap_mode", "clamp")
