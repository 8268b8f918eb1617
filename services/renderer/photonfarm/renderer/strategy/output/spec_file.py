"""Writes settings into a spec's TOML file and keeps everything else byte for byte: comments, order and spaces."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import tomlkit
import tomlkit.items
from tomlkit.exceptions import TOMLKitError

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.files import whole_file
from photonfarm.shared.scene import spec_loading as scene

BYTE_ORDER_MARK = "\ufeff"
"""The character with which some editors begin a file."""

SpecTables = Mapping[str, Mapping[str, int | float | dict[str, Any]]]
"""The numbers and tables to write, by table and key."""


def writable(name: str) -> Path:
    """The file of a spec, if it may be written; raises SpecError for a built-in spec and for a read-only file."""
    file = scene.find_spec(name).resolve()
    if file.parent == (Path(scene.__file__).parent / "specs").resolve():
        raise SpecError(
            f"{name}: is built in and cannot be written; copy {file.name} to a file of your own and plan that"
        )
    if not os.access(file, os.W_OK) or not os.access(file.parent, os.W_OK):
        raise SpecError(f"{file}: cannot be written; allow writing to it and its folder, or leave --write away")
    return file


def write(file: Path, settings: SpecTables) -> None:
    """Write settings into a TOML file, all of them or none; raises SpecError for a file that is not valid TOML."""
    text = file.read_bytes().decode()
    changed = put(text, settings, where=str(file))
    with whole_file(file) as part:
        part.write_bytes(changed.encode())
        shutil.copymode(file, part)


def put(text: str, settings: SpecTables, *, where: str) -> str:
    """A TOML document with new numbers and everything else unchanged; raises SpecError if it is not valid TOML."""
    plain = text.removeprefix(BYTE_ORDER_MARK)
    mark = text[: len(text) - len(plain)]
    try:
        document = tomlkit.parse(plain)
    except TOMLKitError as error:
        raise SpecError(f"{where}: is not valid TOML: {error}") from error
    for name, entries in settings.items():
        if name not in document:
            document[name] = tomlkit.table()
        table = cast(tomlkit.items.AbstractTable, document[name])
        body = table.value.body  # new keys go before the comments at its end, which belong to what follows
        place = max((i + 1 for i, (key, _) in enumerate(body) if key is not None), default=0)
        comments, body[place:] = body[place:], []
        for key, value in entries.items():
            table[key] = value
        body += comments
    changed = tomlkit.dumps(document)
    return mark + (re.sub(r"(?<!\r)\n", "\r\n", changed) if "\r\n" in plain else changed)
