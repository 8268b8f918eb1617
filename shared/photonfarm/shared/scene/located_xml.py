"""XML whose elements know their lines, so that a message can name them."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat

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
