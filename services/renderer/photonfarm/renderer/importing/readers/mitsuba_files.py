"""The files of a Mitsuba scene: read by Mitsuba itself, old ones as copies in the terms of Mitsuba 3."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError
from xml.sax.saxutils import quoteattr

from photonfarm.renderer.importing.readers import mitsuba_old
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.scene.located_xml import Located, line_of, parse

MITSUBA_2 = (2,)
"""Mitsuba 3 reads what is of this version or newer."""


@dataclass(slots=True)
class Files:
    """What is read of a scene, and how."""

    upgrade: mitsuba_old.Upgrade
    scratch: Path
    resolver: Any = None  # Mitsuba's search path, as it is at the end of the scene's first file
    originals: dict[str, Path] = field(default_factory=dict)  # of the copies
    values: dict[str, str] = field(default_factory=dict)  # of <default>, for the names of included files
    shapes: set[str] = field(default_factory=set)  # ids

    def parsed(self, path: Path) -> Any:
        """Mitsuba's nodes of a scene; raises SpecError, with lines of the user's files, for what it cannot read."""
        import mitsuba as mi

        before = mi.file_resolver()
        self.resolver = mi.FileResolver(before)
        self.resolver.prepend(str(path.resolve().parent))
        try:
            read = self._readable(path, self.resolver, ())
            mi.Thread.set_file_resolver(self.resolver)
            config = mi.parser.ParserConfig(mi.variant())
            state = mi.parser.parse_file(config, str(read))
            mi.parser.transform_resolve(config, mi.parser.ParserState(state))  # raises for names of nothing
            return state
        except RuntimeError as error:
            said = self._told(error).replace(f"{path}: ", "")
            raise SpecError(f"{path}: Mitsuba cannot read it: {said}") from error
        finally:
            mi.Thread.set_file_resolver(before)

    def _told(self, error: Exception) -> str:
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

    def _readable(self, file: Path, resolver: Any, around: tuple[Path, ...]) -> Path:
        """A file that Mitsuba can read: itself, or a copy with full names if it or one in it is old or has entities."""
        import mitsuba as mi

        root = _root(file)
        changed = b"<!ENTITY" in file.read_bytes()
        for node in root.iter():
            node.attrib.update({key: self._filled(text) for key, text in node.attrib.items() if "$" in text})
            if node.tag == "shape" and node.get("id") in self.shapes:
                del node.attrib["id"]  # Mitsuba refuses two of a name; it gets another
                changed = True
            elif node.tag == "shape" and "id" in node.attrib:
                self.shapes.add(node.attrib["id"])
            if node.tag == "default":
                self.values.setdefault(node.get("name", ""), node.get("value", ""))
            elif node.tag == "path":
                node.set("value", str(resolver.resolve(node.get("value", ""))))
                resolver.prepend(node.get("value", ""))
            elif (found := Path(str(resolver.resolve(node.get("filename", "/"))))).is_file():
                if node.tag == "include":
                    if found in (*around, file):
                        raise SpecError(f"{file}: line {line_of(node)}: {found} includes itself; take this line out")
                    inner = mi.FileResolver(resolver)
                    inner.prepend(str(found.parent))
                    read = self._readable(found, inner, (*around, file))
                    changed, found = changed or read != found, read
                node.set("filename", str(found.resolve()))
        if _version(root) < MITSUBA_2:
            self.upgrade.run(root, lambda name: self.find(name, file))
        elif not changed:
            return file
        copy = self.scratch / f"{len(self.originals)}-{file.name}"
        copy.write_text(_text(root), encoding="utf-8")
        self.originals[str(copy)] = file
        return copy

    def _filled(self, text: str) -> str:
        for name in sorted(self.values, key=len, reverse=True):  # $max_depth before $max, as Mitsuba does
            text = re.sub(rf"(?<!\\)\${re.escape(name)}", self.values[name].replace("\\", r"\\"), text)
        return text


def _root(file: Path) -> Located:
    try:
        root = parse(file)
    except (OSError, ParseError) as error:
        raise SpecError(f"{file}: is not a readable Mitsuba scene file: {error}") from error
    for node in root.iter():
        if isinstance(node, Located):
            node.file = str(file)
    return root


def _version(root: Element) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", root.get("version", "3")))[:2]


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
