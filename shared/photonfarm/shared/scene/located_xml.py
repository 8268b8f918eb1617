"""XML whose elements know their lines, so that a message can name them."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat


class Located(Element):
    """An element and the line of its file that it begins in."""

    line: int = 0


def line_of(element: Element) -> int:
    """The line of an element; 0 for one that is of no file."""
    return element.line if isinstance(element, Located) else 0


def parse(path: Path) -> Located:
    """The root of an XML file; raises OSError, or ParseError for what is no XML."""
    builder = TreeBuilder(element_factory=Located)
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = builder.start(tag, attributes)
        if isinstance(element, Located):
            element.line = parser.CurrentLineNumber

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    with path.open("rb") as stream:
        try:
            parser.ParseFile(stream)
        except expat.ExpatError as error:
            raise ParseError(str(error)) from error
    root = builder.close()
    assert isinstance(root, Located)  # noqa: S101 - the factory makes no others
    return root
