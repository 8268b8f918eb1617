"""What can be known of a Mitsuba scene file without Mitsuba: its shape ids, its files, and what we cannot render.

Elements of its XML know their lines, so that a message can name them.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat

from photonfarm.core.errors import SpecError


class Located(Element):
    """An element and the line of its file that it begins in."""

    line: int = 0
    file: str = ""  # where a message has to say which


def line_of(element: Element) -> int:
    """The line of an element; 0 for one that is of no file."""
    return element.line if isinstance(element, Located) else 0


def parse(path: Path) -> Located:
    """The root of an XML file; raises OSError, or ParseError for what is no XML and for what has a DOCTYPE."""
    builder = TreeBuilder(element_factory=Located)
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = builder.start(tag, attributes)
        if isinstance(element, Located):
            element.line = parser.CurrentLineNumber

    def refuse(*entity: str | bool | None) -> None:  # its name first, its file fifth; nothing for a whole DOCTYPE
        file = f"{entity[4]}" if entity and entity[4] else "…"
        of_file = f" of file {file!r}" if entity and entity[4] else ""
        what = f"entity {entity[0]!r}{of_file}, which stands" if entity else "a DOCTYPE, whose entities stand"
        raise ParseError(
            f"line {parser.CurrentLineNumber}: has {what} for content that is not read; "
            f'write <include filename="{file}"/> where it is named, or the content itself'
        )

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.EntityDeclHandler = parser.EndDoctypeDeclHandler = refuse
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        raise ParseError(str(error)) from error
    root = builder.close()
    assert isinstance(root, Located)  # noqa: S101 - the factory makes no others
    return root


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
    """The facts of one scene file, or of a built-in room."""

    shape_ids: frozenset[str]
    emitting: frozenset[str]  # ids of the shapes that are lights
    shapeless: frozenset[str]  # lights that are not shapes: ENVIRONMENT, and the ids of others that have one
    has_unnamed_light: bool  # a shape or another light without an id shines
    digest: str  # of the file and of every file it names

    @classmethod
    def read(cls, path: Path) -> SceneFile:
        """Read and check a scene; raises SpecError for a missing file or an unsupported feature."""
        try:
            root = parse(path)
        except (OSError, ParseError) as error:
            raise SpecError(f"{path}: is not a readable Mitsuba scene file: {error}") from error
        _refuse_unsupported(root, path)
        shapes = {node.get("id", ""): node for node in root.iter("shape") if node.get("id")}
        lights = {node.get("id") for node in root.iter("emitter")} - {None}
        emitting = {name for name, node in shapes.items() if _emits(node, lights)}
        unnamed = any(not node.get("id") and _emits(node, lights) for node in root.iter("shape")) or any(
            not node.get("id") and node.get("type") not in ("area", *_ENVIRONMENTS) for node in root.findall("emitter")
        )
        digest = hashlib.sha256(path.read_bytes())
        for file in _named_files(root, path):
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        return cls(frozenset(shapes), frozenset(emitting), frozenset(_shapeless(root)), unnamed, digest.hexdigest())

    @property
    def lights(self) -> frozenset[str]:
        """The ids of all lights; "" stands for those that have none."""
        return self.emitting | self.shapeless | ({""} if self.has_unnamed_light else frozenset())


TEXTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm")
"""The names' ends of images that can be read here; Mitsuba alone reads EXR, HDR and PFM."""

OWN_FILES = (*TEXTURES, ".exr", ".hdr", ".rgbe", ".pfm", ".obj", ".ply", ".serialized", ".bsdf", ".spd")
"""The names' ends of files that a scene which stands alone may have beside its own."""


def check_textures(path: Path) -> None:
    """Read the images that a readable scene names, as far as they end in `TEXTURES`; SpecError for one that is damaged.

    Workers would find that only when all is planned.
    """
    from PIL import Image

    for file in _named_files(parse(path), path):
        if file.suffix.lower() in TEXTURES:
            try:
                with Image.open(file) as image:
                    image.load()
            except Image.DecompressionBombError:  # too large for a web page, and perhaps not for a scene
                continue
            except (OSError, SyntaxError, ValueError) as error:
                raise SpecError(f"{path}: texture {file} cannot be read: {error}; put the whole file there") from error


def _builtin(name: str, dark: str, emitting: str) -> SceneFile:
    revision = 1  # incremented whenever a built-in room changes, as its content is code and not a file
    lights = frozenset(emitting.split())
    return SceneFile(lights.union(dark.split()), lights, frozenset(), False, f"builtin {name} {revision}")


_CORNELL = "floor ceiling back-wall left-wall right-wall tall-block short-block"
_ROOM = """
    floor ceiling wall-back wall-front wall-left wall-right skirting door painting-frame painting rug
    table-wood table-bowl chair-1-wood chair-1-cushion chair-2-wood chair-2-cushion sofa-fabric sofa-pillows sofa-feet
    shelf-wood shelf-books-red shelf-books-blue shelf-books-cream lamp-stand
    pedestal-stone pedestal-ball mirror-frame mirror-glass vase-copper
"""

BUILTIN = {
    "cornell": _builtin("cornell", _CORNELL, "ceiling-light"),
    "room": _builtin("room", _ROOM, "lamp-shade ceiling-light-1 ceiling-light-2"),
}
"""The facts of the built-in rooms, listed here so that a spec can be checked without Mitsuba."""


def _emits(shape: Element, lights: Set[str | None]) -> bool:
    return any(part.tag == "emitter" or (part.tag == "ref" and part.get("id") in lights) for part in shape)


def _shapeless(root: Element) -> Iterator[str]:
    for node in root.findall("emitter"):
        if node.get("type") in _ENVIRONMENTS:
            yield ENVIRONMENT
        elif node.get("type") != "area" and node.get("id"):  # one of type area is there for shapes to refer to
            yield node.get("id", "")


def _refuse_unsupported(root: Element, path: Path) -> None:
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


def _named_files(root: Element, path: Path) -> list[Path]:
    files = []
    for name in _list_names(root):
        file = path.parent / name
        if not file.is_file():
            raise SpecError(f"{path}: filename = {name!r} is not there")
        files.append(file)
    return sorted(set(files))


def _list_names(root: Element) -> list[str]:
    return [node.get("value", "") for node in root.iter("string") if node.get("name") == "filename"]


_TYPE = re.compile(r"\w+")


def list_own_files(path: Path, parameters: Mapping[str, str]) -> list[str]:
    """The files that a readable scene names, relative to its own, for a copy that stands alone.

    `parameters` are values for its <default> names.

    Raises SpecError for a file outside of the scene's folder, and for what may be code: a file that is neither mesh nor
    image nor table of numbers, and a type that is no plugin's name, as Mitsuba would look for a library there.
    """
    root = parse(path)
    of_spectra = [file for node in root.iter() if (file := node.get("filename")) is not None]
    names = sorted({str(PurePosixPath(name)) for name in (*_list_names(root), *of_spectra)})
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or {*name} & {*"\\$"}:
            raise SpecError(f"{path}: filename = {name!r} is no file below the scene's folder; copy it there")
        if PurePosixPath(name).suffix.lower() not in OWN_FILES:
            raise SpecError(f"{path}: filename = {name!r} is none of {', '.join(OWN_FILES)}")
    values = [(node.get("name", ""), node.get("value", "")) for node in root.iter("default")] + [*parameters.items()]
    for node in root.iter():
        where, kind = f"{path}: line {line_of(node)}", node.get("type")
        if node.tag == "path" or "$" in node.get("name", ""):
            raise SpecError(f"{where}: <{node.tag}> may name files elsewhere; write what it stands for instead")
        if kind is not None:
            possible = [value for name, value in values if kind.startswith(f"${name}")]
            if not all(map(_TYPE.fullmatch, (kind.removeprefix("$"), *possible))):
                raise SpecError(f"{where}: type = {kind!r} is no plugin's name")
    return names
