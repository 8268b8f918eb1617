"""Settings written into a spec's TOML file, which keeps everything else byte for byte: comments, order, spaces."""

from __future__ import annotations

import json
import os
import re
import shutil
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.scene import spec as scene

BYTE_ORDER_MARK = "\ufeff"
"""The byte-order mark with which some editors begin a file."""

Settings = Mapping[str, Mapping[str, int | float]]
"""Table → key → number."""


def writable(name: str) -> Path:
    """The file of a spec that may be written. Raises SpecError for a built-in one and for one that is read-only."""
    file = scene.find_spec(name).resolve()
    if file.parent == (Path(scene.__file__).parent / "specs").resolve():
        raise SpecError(
            f"{name}: is built in and cannot be written; copy {file.name} to a file of your own and plan that"
        )
    if not os.access(file, os.W_OK) or not os.access(file.parent, os.W_OK):
        raise SpecError(f"{file}: cannot be written; allow writing to it and its folder, or leave --write away")
    return file


def write(file: Path, settings: Settings) -> None:
    """Write settings into a TOML file, atomically.

    Raises SpecError if a table is written in a form that leaves no place for them.
    """
    text = file.read_bytes().decode()
    changed = put(text, settings, where=str(file))
    aside = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(changed.encode())
        shutil.copymode(file, aside)
        aside.replace(file)
    finally:
        aside.unlink(missing_ok=True)


def put(text: str, settings: Settings, *, where: str) -> str:
    """A TOML document with other numbers in some of its tables; SpecError if it cannot be edited safely."""
    body = text.removeprefix(BYTE_ORDER_MARK)
    mark = text[: len(text) - len(body)]
    try:
        wanted = _merged(tomllib.loads(body), settings)
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{where}: is not valid TOML: {error}") from error
    for table, entries in settings.items():
        body = _put_table(body, table, entries)
    try:
        safe = _canonical(tomllib.loads(body)) == _canonical(wanted)
    except tomllib.TOMLDecodeError:
        safe = False
    if not safe:
        tables = " and ".join(f"[{table}]" for table in settings)
        raise SpecError(f"{where}: write {tables} as tables with a line per key, so that they can be edited in place")
    return mark + body


def _canonical(document: dict[str, Any]) -> str:
    """A text for comparisons, in which a NaN equals itself."""
    return json.dumps(document, sort_keys=True, default=repr)


def _merged(document: dict[str, Any], settings: Settings) -> dict[str, Any]:
    return document | {table: document.get(table, {}) | dict(entries) for table, entries in settings.items()}


def _put_table(text: str, table: str, entries: Mapping[str, int | float]) -> str:
    newline = "\r\n" if "\r\n" in text else "\n"
    header = re.search(rf"^[ \t]*\[[ \t]*{table}[ \t]*\][^\n]*(?:\n|\Z)", text, re.MULTILINE)
    if header is None:
        lead = "" if not text or text.endswith("\n") else newline
        body = "".join(f"{key} = {value!r}{newline}" for key, value in entries.items())
        return f"{text}{lead}{newline}[{table}]{newline}{body}"
    following = re.compile(r"^[ \t]*\[", re.MULTILINE).search(text, header.end())
    end = following.start() if following else len(text)
    body = text[header.end() : end]
    for key, value in entries.items():
        body = _put_key(body, key, value, newline)
    head = text[: header.end()]
    return head + ("" if head.endswith("\n") else newline) + body + text[end:]


def _put_key(body: str, key: str, value: int | float, newline: str) -> str:
    present = re.compile(rf"^([ \t]*{key}[ \t]*=[ \t]*)[^\s#]+", re.MULTILINE)
    if present.search(body):
        return present.sub(lambda found: f"{found[1]}{value!r}", body, count=1)
    keys = re.finditer(r"^[ \t]*[A-Za-z0-9_.\"'-]+[ \t]*=[^\n]*(?:\n|\Z)", body, re.MULTILINE)
    place = max((found.end() for found in keys), default=0)
    lead = "" if place == 0 or body[:place].endswith("\n") else newline
    return f"{body[:place]}{lead}{key} = {value!r}{newline}{body[place:]}"
