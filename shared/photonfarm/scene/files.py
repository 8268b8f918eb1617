"""What can be known of a Mitsuba scene file without Mitsuba: its shape ids, its files, and what we cannot render.

Elements of its XML know their lines, so that a message can name them.
"""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Set
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat

from photonfarm.core.errors import SpecError

_TAG = re.compile(rb"""<[^\s>"']+(?:[^>"']|"[^"]*"|'[^']*')*>""")
"""A tag as it is written, with its attributes."""


class Located(Element):
    """An element and the line of its file that it begins in."""

    line: int = 0
    file: str = ""  # where a message has to say which


def line_of(element: Element) -> int:
    """The line of an element; 0 for one that is of no file."""
    return element.line if isinstance(element, Located) else 0


def parse(path: Path) -> Located:
    """The root of an XML file; raises OSError, or ParseError for what is no XML and for content that lies elsewhere."""
    builder = TreeBuilder(element_factory=Located)
    parser = expat.ParserCreate()
    data = path.read_bytes()
    known, has_entities = {"lt", "gt", "amp", "quot", "apos"}, b"<!DOCTYPE" in data

    def refuse(name: str, *_: object) -> int:
        raise ParseError(
            f"line {parser.CurrentLineNumber}: entity {name!r} stands for content of another file, which is not read; "
            'write <include filename="…"/> in its place, or the content itself'
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        written = _TAG.match(data, parser.CurrentByteIndex) if has_entities else None
        for name in re.findall(rb"&([^#;\s][^;\s]*);", written[0]) if written else ():
            if name.decode() not in known:  # expat leaves it out without a word
                refuse(name.decode())
        element = builder.start(tag, attributes)
        if isinstance(element, Located):
            element.line = parser.CurrentLineNumber

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.EntityDeclHandler = lambda name, *_: known.add(name)
    parser.ExternalEntityRefHandler = parser.SkippedEntityHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        named = re.match(rb"&([^;\s]+);", data[parser.ErrorByteIndex :])
        raise ParseError(f"{error}{f' ({named[1].decode()})' if named else ''}") from error
    root = builder.close()
    assert isinstance(root, Located)  # noqa: S101 - the factory makes no others
    return root


BUILTIN_REVISION = 1
"""Incremented whenever a built-in room changes, as its content is code and not a file."""

_CORNELL = "floor ceiling back-wall left-wall right-wall tall-block short-block ceiling-light"
_ROOM = """
    floor ceiling wall-back wall-front wall-left wall-right skirting door painting-frame painting rug
    table-wood table-bowl chair-1-wood chair-1-cushion chair-2-wood chair-2-cushion sofa-fabric sofa-pillows sofa-feet
    shelf-wood shelf-books-red shelf-books-blue shelf-books-cream lamp-stand lamp-shade
    pedestal-stone pedestal-ball mirror-frame mirror-glass vase-copper ceiling-light-1 ceiling-light-2
"""

BUILTIN_SHAPES = {"cornell": frozenset(_CORNELL.split()), "room": frozenset(_ROOM.split())}
"""The shape ids of the built-in rooms, listed here so that a spec can be checked without Mitsuba."""

BUILTIN_EMITTING = {
    "cornell": frozenset({"ceiling-light"}),
    "room": frozenset({"lamp-shade", "ceiling-light-1", "ceiling-light-2"}),
}
"""The shapes among them that emit light."""

ENVIRONMENT = "environment"
"""The name of the light that surrounds the scene; a scene has one at most."""

_ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")

_UNSUPPORTED = {
    "medium": "participating media are not supported; only surfaces are",
    "phase": "participating media are not supported; only surfaces are",
    "volume": "volumes are not supported; only surfaces are",
}
POLARISED = ("measured_polarized", "polarizer", "retarder", "circular")
"""The materials that are not supported: those that polarise."""

SHAPES = ("obj", "ply", "serialized", "rectangle", "cube", "sphere", "disk", "cylinder")
"""Shapes with a base point cloud; instances and curves have none."""


@dataclass(frozen=True, slots=True)
class SceneFile:
    """The facts of one scene file."""

    path: Path
    shape_ids: frozenset[str]
    emitting: frozenset[str]  # ids of the shapes that are lights
    shapeless: frozenset[str]  # lights that are not shapes: ENVIRONMENT, and the ids of others that have one
    has_unnamed_light: bool  # a shape or another light without an id shines
    digest: str  # of the file and of every file it names

    @classmethod
    def read(cls, path: Path) -> SceneFile:
        """Read and check a scene; raises SpecError for a missing file or an unsupported feature."""
        root = _parse(path)
        _refuse_unsupported(root, path)
        shapes = {node.get("id", ""): node for node in root.iter("shape") if node.get("id")}
        lights = {node.get("id") for node in root.iter("emitter")} - {None}
        emitting = {name for name, node in shapes.items() if _emits(node, lights)}
        unnamed = any(not node.get("id") and _emits(node, lights) for node in root.iter("shape")) or any(
            not node.get("id") and node.get("type") not in ("area", *_ENVIRONMENTS) for node in root.findall("emitter")
        )
        digest = _digest(path, _named_files(root, path))
        return cls(path, frozenset(shapes), frozenset(emitting), frozenset(_shapeless(root)), unnamed, digest)

    @property
    def lights(self) -> frozenset[str]:
        """The ids of all lights; "" stands for those that have none."""
        return self.emitting | self.shapeless | ({""} if self.has_unnamed_light else frozenset())


def _emits(shape: ElementTree.Element, lights: Set[str | None]) -> bool:
    return any(part.tag == "emitter" or (part.tag == "ref" and part.get("id") in lights) for part in shape)


def _shapeless(root: ElementTree.Element) -> Iterator[str]:
    for node in root.findall("emitter"):
        if node.get("type") in _ENVIRONMENTS:
            yield ENVIRONMENT
        elif node.get("type") != "area" and node.get("id"):  # one of type area is there for shapes to refer to
            yield node.get("id", "")


def _parse(path: Path) -> ElementTree.Element:
    try:
        return parse(path)
    except (OSError, ElementTree.ParseError) as error:
        raise SpecError(f"{path}: is not a readable Mitsuba scene file: {error}") from error


def _refuse_unsupported(root: ElementTree.Element, path: Path) -> None:
    around = {part: node for node in root.iter() for part in node}
    for node in root.iter():
        reason = _UNSUPPORTED.get(node.tag)
        if node.tag == "bsdf" and node.get("type") in POLARISED:
            reason = "polarisation is not supported"
        if node.tag == "shape" and node.get("type") not in SHAPES:
            reason = f"shapes of type {node.get('type')!r} are not supported; only {', '.join(SHAPES)}"
        if node.tag == "include":
            reason = "included scene files are not supported; join them into one file"
        if reason:
            name = node.get("id") or node.get("name") or node.get("type")
            shape = around.get(node, root)
            whose = f" of shape {shape.get('id', '')!r}" if shape.tag == "shape" else ""
            remedy = f"`photonfarm scene import {path.name}` makes a copy of the scene without what is not supported"
            raise SpecError(f"{path}: line {line_of(node)}: <{node.tag}> {name!r}{whose}: {reason}; {remedy}")


def _named_files(root: ElementTree.Element, path: Path) -> list[Path]:
    files = []
    for node in root.iter("string"):
        if node.get("name") == "filename":
            file = path.parent / node.get("value", "")
            if not file.is_file():
                raise SpecError(f"{path}: filename = {node.get('value')!r} is not there")
            files.append(file)
    return sorted(set(files))


def _digest(path: Path, files: list[Path]) -> str:
    digest = hashlib.sha256(path.read_bytes())
    for file in files:
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
