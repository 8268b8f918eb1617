"""The faces of PLY files, looked at before Mitsuba reads them: it crashes on vertices that are not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
"""NumPy's types by those of the format."""

_INDICES = ("vertex_index", "vertex_indices")

Property = tuple[str, str, str]
"""Its name, its type and that of its length, which is empty for what is no list."""

Part = tuple[str, int, list[Property]]
"""The name, the count and the properties of an element, such as `vertex`."""


def fault(file: Path) -> str:
    """What face names a vertex that is not there; empty for none, and for a file that Mitsuba itself refuses."""
    try:
        return _fault(*_read(file.read_bytes()))
    except (ValueError, KeyError, IndexError):
        return ""


def _read(data: bytes) -> tuple[list[Part], bytes]:
    """The elements of a file, and its values as binary ones."""
    end = data.index(b"\n", data.index(b"end_header")) + 1
    parts: list[Part] = []
    order = ""
    for words in (line.split() for line in data[:end].decode("latin-1").splitlines()):
        if words[:1] == ["format"]:
            order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[:1] == ["element"]:
            parts.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            parts[-1][2].append((words[4], order + _TYPES[words[3]], order + _TYPES[words[2]]))
        elif words[:1] == ["property"]:
            parts[-1][2].append((words[2], order + _TYPES[words[1]], ""))
    if order:
        return parts, data[end:]
    numbers = [(name, count, [(key, "f8", of and "f8") for key, _, of in held]) for name, count, held in parts]
    return numbers, np.array(data[end:].split()).astype(np.float64).tobytes()


def _fault(parts: list[Part], data: bytes) -> str:
    vertices = next(count for name, count, _ in parts if name == "vertex")
    at = 0
    for name, count, properties in parts:
        first = 0
        while first < count:
            kind = np.dtype(_fields(properties, data, at))
            rows = np.frombuffer(data, kind, min(count - first, (len(data) - at) // kind.itemsize), at)
            lengths = [rows[f"length of {key}"] for key, _, of in properties if of]
            same = np.array([each == each[:1] for each in lengths] or np.ones((1, len(rows)))).all(axis=0)
            rows = rows if same.all() else rows[: int(same.argmin())]
            for key in _INDICES if name == "face" else ():
                corners = rows[key] if key in (kind.names or ()) else np.zeros((0, 0))
                bad = np.argwhere((corners < 0) | (corners >= vertices))
                if len(bad):
                    face, corner = bad[0]
                    return f"face {first + face} names vertex {corners[face, corner]:.0f}, and it has {vertices}"
            if not len(rows):
                return ""  # it ends before; Mitsuba says so
            first, at = first + len(rows), at + len(rows) * kind.itemsize
    return ""


def _fields(properties: list[Property], data: bytes, at: int) -> list[tuple[str, str, tuple[int, ...]]]:
    """The fields of an element as it is at a place, with as many values in each list as it has there."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for key, kind, of in properties:
        shape: tuple[int, ...] = ()
        if of:
            length = int(np.frombuffer(data, of, 1, at)[0])
            fields.append((f"length of {key}", of, ()))
            at, shape = at + np.dtype(of).itemsize, (length,)
        fields.append((key, kind, shape))
        at += np.dtype(kind).itemsize * (shape[0] if shape else 1)
    return fields
