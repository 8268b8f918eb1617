"""Writes settings into a spec's TOML file and keeps everything else byte for byte: comments, order and spaces."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import tomlkit
import tomlkit.items
from tomlkit.exceptions import TOMLKitError

from photonfarm.core.errors import SpecError
from photonfarm.core.files import whole_file
from photonfarm.scene import spec_loading as scene

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
        tomlkit.parse(plain)
        for name, entries in settings.items():
            part = _part_of(plain, name)
            gap = "\n" if not plain[part].strip() and plain[: part.start].strip() else ""
            plain = plain[: part.start] + gap + _put_table(plain[part], name, entries) + plain[part.stop :]
    except TOMLKitError as error:
        raise SpecError(f"{where}: is not valid TOML: {error}") from error
    return mark + (re.sub(r"(?<!\r)\n", "\r\n", plain) if "\r\n" in text else plain)


def _part_of(text: str, name: str) -> slice:
    """The part of a document that holds a table, or its end.

    tomlkit reads this part alone, as it moves comments in documents in which [[objects]] and [[lights]] alternate.
    """
    tables = list(_tables(text))
    begins = [at for at, _ in tables] + [len(text)]
    if name in tomlkit.parse(text[: begins[0]]):
        return slice(0, begins[0])
    own = [number for number, (_, key) in enumerate(tables) if key == name]
    if not own:
        return slice(len(text), len(text))
    return slice(begins[own[0]], begins[own[-1] + 1])


def _tables(text: str) -> Iterator[tuple[int, str]]:
    """Where each table of a document begins, and the first key of its header."""
    begin = 0  # of the table before
    for header in re.finditer(r"^[ \t]*\[.*$", text, re.MULTILINE):
        try:  # what stands in a list or a string of several lines is no header
            tomlkit.parse(text[begin : header.start()])
            (key,) = tomlkit.parse(header.group())
        except (TOMLKitError, ValueError):
            continue
        begin = header.start()
        yield begin, key


def _put_table(text: str, name: str, entries: Mapping[str, int | float | dict[str, Any]]) -> str:
    """The part of a document that holds a table, with new entries.

    They come before the comments that end it, as those belong to what follows.
    """
    own = re.sub(r"(^[ \t\r]*(#.*)?(\n|\Z))*\Z", "", text, flags=re.MULTILINE)
    document = tomlkit.parse(own)
    if name not in document:
        document[name] = tomlkit.table()
    _update(cast(tomlkit.items.AbstractTable, document[name]), entries)
    written = tomlkit.dumps(document)
    return written.rstrip("\r\n") + "\n" + text[len(own) :]


def _update(table: tomlkit.items.AbstractTable, entries: Mapping[str, Any]) -> None:
    """Write entries into a table; one that is a table already becomes equal, and keeps its form and its comments."""
    for key, value in entries.items():
        old = table.get(key)
        if isinstance(value, dict) and isinstance(old, tomlkit.items.Table):
            for gone in set(old) - set(value):
                del old[gone]
            _update(old, value)
        elif isinstance(value, dict) and isinstance(old, tomlkit.items.InlineTable):
            table[key] = tomlkit.inline_table()
            table[key].update(value)
        else:
            table[key] = value
