"""HTML pages from Jinja2 templates. Each is one file that needs no other: pictures are in it."""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from photonfarm.shared.core.pictures import data_uri

HERE = Path(__file__).parent


def rendered(template: Path, **values: Any) -> str:
    """The page of a template; `page.html.j2`, which it may extend, lies beside this module. Text is escaped."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, HERE]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"uri": data_uri, "breakable": breakable, "base64": lambda data: b64encode(data).decode()}
    return environment.get_template(template.name).render(**values)


def breakable(text: str) -> Markup:
    """A text whose names may break after an underscore."""
    return Markup(str(escape(text)).replace("_", "_<wbr>"))  # noqa: S704 - it is escaped
