"""The optional configuration file: defaults for the command line's options."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from photonfarm.shared.errors import SpecError


def file_defaults(path: Path) -> dict[str, Any]:
    """Option defaults by verb from a TOML file; empty where there is none. Raises SpecError if it is not TOML.

    A table per verb (`[train]`, `[work]`, …); what stands above all tables applies to every verb.
    """
    if not path.is_file():
        return {}
    try:
        tables = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SpecError(f"{path}: is not a readable TOML file: {error}") from error
    common = {_option(k): v for k, v in tables.items() if not isinstance(v, dict)}
    verbs = ("doctor", "preview", "report", "status", "submit", "train", "up", "work")
    return {verb: {**common, **{_option(k): v for k, v in tables.get(verb, {}).items()}} for verb in verbs}


def _option(key: str) -> str:
    return key.replace("-", "_")
