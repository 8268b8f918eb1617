"""The optional configuration file: defaults for the command line's options."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from photonfarm.core.errors import SpecError

Options = Mapping[str, Mapping[str, str]]
"""The options of each verb, and of each subcommand as "verb.subcommand": names without dashes → parameters."""

EVERY_VERB = "all"
"""The table of what holds for every verb. It needs no place above the tables, where TOML would not take `store` beside
a table [store.check]."""


def file_defaults(path: Path, options: Options) -> dict[str, Any]:
    """Defaults by verb from a TOML file: a table per verb; the table `all` holds for every verb that has its keys.

    Keys above all tables do the same, and `all` overrules them. A subcommand's table is `[verb.subcommand]`; its
    defaults are stored under its name among those of its verb. Raises SpecError for a file that cannot be read, and for
    a verb or an option that does not exist.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SpecError(f"{path}: is not a readable TOML file: {error}") from error
    defaults: dict[str, Any] = {verb: {} for verb in options if "." not in verb}
    common = tables.pop(EVERY_VERB, {})
    if not isinstance(common, dict):
        raise SpecError(f"{path}: {EVERY_VERB} = {common!r}: is the table [{EVERY_VERB}], of options of every verb")
    named = [key for key, value in tables.items() if key in options and isinstance(value, dict)]
    above = {key: value for key, value in tables.items() if key not in named}
    for key, value in (above | common).items():
        takers = [verb for verb, known in options.items() if key in known]
        if not takers or isinstance(value, dict):
            place = f"{EVERY_VERB}.{key}" if key in common else key
            rule = "no option of any verb" if key in common else "neither a verb with a table nor an option of any verb"
            raise SpecError(f"{path}: {place} = {value!r}: is {rule}")
        for verb in takers:
            _of(defaults, verb)[options[verb][key]] = value
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
