"""glTF 2.0 containers: the JSON document, its buffers, and the arrays and images in them."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.errors import SpecError

Node = Mapping[str, Any]

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942

_COMPRESSED = {
    "KHR_draco_mesh_compression": "its meshes are compressed by Draco",
    "EXT_meshopt_compression": "its meshes are compressed by meshopt",
    "KHR_texture_basisu": "its textures are in KTX2",
}
"""What changes how bytes are read, so that nothing can be read without it."""


class GltfFile:
    """One glTF file with all that it names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document, self._binary = _opened(path)
        version = str(self.document.get("asset", {}).get("version", ""))
        if not version.startswith("2."):
            raise SpecError(f"{path}: is glTF of version {version or 'unknown'!r}; only version 2 is read")
        for extension in self.document.get("extensionsRequired", ()):
            if extension in _COMPRESSED:
                raise SpecError(
                    f"{path}: {_COMPRESSED[extension]} ({extension}), which is not read; export it without compression"
                )

    def all(self, kind: str) -> list[Node]:
        """The entries of one array of the document, such as meshes."""
        return list(self.document.get(kind, ()))

    @cached_property
    def _buffers(self) -> list[bytes]:
        return [self._buffer(entry, number) for number, entry in enumerate(self.all("buffers"))]

    def _buffer(self, entry: Node, number: int) -> bytes:
        if "uri" in entry:
            return self._read(entry["uri"], f"buffer {number}")
        if self._binary is None:
            raise SpecError(f"{self.path}: buffer {number} has no uri, and the file has no binary chunk")
        return self._binary

    def _read(self, uri: str, what: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        file = self.path.parent / unquote(uri)
        try:
            return file.read_bytes()
        except OSError as error:
            reason = error.strerror or str(error)
            raise SpecError(f"{self.path}: {what}: {unquote(uri)!r} cannot be read: {reason}") from error

    def _view(self, number: int) -> tuple[bytes, int]:
        """The bytes of a buffer view, and its stride."""
        view = self.all("bufferViews")[number]
        start = view.get("byteOffset", 0)
        return self._buffers[view["buffer"]][start : start + view["byteLength"]], view.get("byteStride", 0)

    def array(self, number: int) -> NDArray[Any]:
        """The values of an accessor, (N, width): integers as they are, unless normalised to floats."""
        accessor = self.all("accessors")[number]
        width, count = _WIDTHS[accessor["type"]], accessor["count"]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            values = self._strided(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width)
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in accessor:
            values = self._with_sparse(values, accessor["sparse"], kind)
        return _normalised(values) if accessor.get("normalized") else values

    def _strided(self, view: int, offset: int, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        data, stride = self._view(view)
        step = stride or width * kind.itemsize
        needed = offset + (count - 1) * step + width * kind.itemsize
        if count and len(data) < needed:
            raise SpecError(f"{self.path}: buffer view {view} has {len(data)} bytes, and an accessor needs {needed}")
        return np.ndarray((count, width), kind, data, offset, (step, kind.itemsize)).copy()

    def _with_sparse(self, values: NDArray[Any], sparse: Node, kind: np.dtype[Any]) -> NDArray[Any]:
        where, what, count = sparse["indices"], sparse["values"], sparse["count"]
        places = self._strided(
            where["bufferView"], where.get("byteOffset", 0), np.dtype(_TYPES[where["componentType"]]), count, 1
        )
        values[places[:, 0]] = self._strided(
            what["bufferView"], what.get("byteOffset", 0), kind, count, values.shape[1]
        )
        return values

    def image(self, number: int) -> tuple[str, bytes]:
        """The name and the encoded bytes of an image."""
        entry = self.all("images")[number]
        if "bufferView" in entry:
            return entry.get("name", f"image_{number}"), self._view(entry["bufferView"])[0]
        uri = entry["uri"]
        named = entry.get("name") or ("" if uri.startswith("data:") else Path(unquote(uri)).stem)
        return named or f"image_{number}", self._read(uri, f"image {number}")


def _normalised(values: NDArray[Any]) -> NDArray[np.float32]:
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    return np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1.0).astype(np.float32)


def _opened(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """The document of a file, and its binary chunk."""
    try:
        data = path.read_bytes()
        text, binary = _chunks(data) if data[:4] == b"glTF" else (data, None)
        document = json.loads(text)
    except (OSError, ValueError, struct.error) as error:
        raise SpecError(f"{path}: is not a readable glTF file: {error}") from error
    if not isinstance(document, dict):
        raise SpecError(f"{path}: is not a readable glTF file: its JSON is no object")
    return document, binary


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    found: dict[int, bytes] = {}
    place = 12
    while place + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, place)
        found.setdefault(kind, data[place + 8 : place + 8 + length])
        place += 8 + length
    if _JSON not in found:
        raise ValueError("it has no JSON chunk")
    return found[_JSON], found.get(_BINARY)
