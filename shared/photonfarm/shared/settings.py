"""The optional configuration file: defaults for the command line's options."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from photonfarm.shared.errors import SpecError


def file_defaults(path: Path, options: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Any]]:
    """Defaults by verb from a TOML file: a table per verb, and above all tables what holds for every verb that has it.

    `options` are the options that each verb has, as written without dashes, and the parameters they stand for. Raises
    SpecError for a file that cannot be read, and for a verb or an option that does not exist.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SpecError(f"{path}: is not a readable TOML file: {error}") from error
    defaults: dict[str, dict[str, Any]] = {verb: {} for verb in options}
    for key, value in tables.items():
        if key in options and isinstance(value, dict):
            continue
        takers = [verb for verb, known in options.items() if key in known]
        if not takers or isinstance(value, dict):
            raise SpecError(f"{path}: {key} = {value!r}: is neither a verb with a table nor an option of any verb")
        for verb in takers:
            defaults[verb][options[verb][key]] = value
    for verb, known in options.items():
        for key, value in tables.get(verb, {}).items():
            if key not in known:
                raise SpecError(f"{path}: {verb}.{key} = {value!r}: options of {verb} are {', '.join(sorted(known))}")
            defaults[verb][known[key]] = value
    return defaults
