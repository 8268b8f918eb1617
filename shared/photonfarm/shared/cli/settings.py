"""The optional configuration file: defaults for the command line's options."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from photonfarm.shared.core.errors import SpecError

Options = Mapping[str, Mapping[str, str]]
"""The options of each verb, and of each subcommand as "verb.subcommand": names without dashes → parameters."""


def file_defaults(path: Path, options: Options) -> dict[str, Any]:
    """Defaults by verb from a TOML file: a table per verb; keys above all tables hold for every verb that has them.

    A subcommand's table is `[verb.subcommand]`; its defaults are stored under its name among those of its verb. Raises
    SpecError for a file that cannot be read, and for a verb or an option that does not exist.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SpecError(f"{path}: is not a readable TOML file: {error}") from error
    defaults: dict[str, Any] = {verb: {} for verb in options if "." not in verb}
    named = [key for key, value in tables.items() if key in options and isinstance(value, dict)]
    for key in (key for key in tables if key not in named):
        takers = [verb for verb, known in options.items() if key in known]
        if not takers or isinstance(tables[key], dict):
            raise SpecError(
                f"{path}: {key} = {tables[key]!r}: is neither a verb with a table nor an option of any verb"
            )
        for verb in takers:
            _of(defaults, verb)[options[verb][key]] = tables[key]
    for verb in named:
        _read_table(path, verb, tables[verb], options, defaults)
    return defaults


def _read_table(path: Path, verb: str, table: Mapping[str, Any], options: Options, defaults: dict[str, Any]) -> None:
    for key, value in table.items():
        if isinstance(value, dict) and f"{verb}.{key}" in options:
            _read_table(path, f"{verb}.{key}", value, options, defaults)
            continue
        if key not in options[verb]:
            known = ", ".join(sorted(options[verb])) or "none"
            raise SpecError(f"{path}: {verb}.{key} = {value!r}: options of {verb.replace('.', ' ')} are {known}")
        _of(defaults, verb)[options[verb][key]] = value


def _of(defaults: dict[str, Any], verb: str) -> dict[str, Any]:
    """The defaults of one verb or subcommand."""
    for name in verb.split("."):
        defaults = defaults.setdefault(name, {})
    return defaults
