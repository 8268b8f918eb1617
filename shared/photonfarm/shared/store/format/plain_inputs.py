"""Reads a plan's inputs as they are written here, without zarr-python: its import alone takes longer than `status`.

Nor with the checksum that shards use, for the same reason: inputs are small, and google-crc32c loads in 2 ms.
"""

from __future__ import annotations

import json
from math import ceil
from typing import TYPE_CHECKING, Any

import google_crc32c
import numcodecs.blosc  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from photonfarm.shared.store.io.storage import Storage

_CRC_BYTES = 4
_CODECS = (["bytes", "blosc", "crc32c"], ["bytes", "crc32c"])
_FLAT = {"name": "default", "configuration": {"separator": "."}}

UNLIKE = (OSError, ValueError, LookupError, TypeError, RuntimeError)
"""The errors of what is not as it is written here, or is damaged: zarr-python reads what it can, and says the rest."""


def read_plain(storage: Storage, group: str, names: list[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
    """The attributes of a group and the arrays of these names in it, if all are such as we write them, and whole.

    None otherwise: zarr-python reads what it can, and says what is wrong.
    """
    try:
        attributes = json.loads(storage.read(f"{group}/zarr.json"))["attributes"]
        return attributes, {name: PlainInput(storage, f"{group}/{name}").all() for name in names}
    except UNLIKE:
        return None


class PlainInput:
    """An array of inputs, read whole or by the chunks of its rows. Everything raises one of UNLIKE."""

    def __init__(self, storage: Storage, folder: str) -> None:
        """Read how the array is laid out."""
        self._storage, self._folder = storage, folder
        about = json.loads(storage.read(f"{folder}/zarr.json"))
        codecs = [codec["name"] for codec in about["codecs"]]
        endian = about["codecs"][0].get("configuration", {}).get("endian", "little")
        if codecs not in _CODECS or endian != "little" or about["chunk_key_encoding"] != _FLAT:
            raise ValueError(f"{folder}: is not written here")
        self._is_compressed = "blosc" in codecs
        self._chunk = tuple(about["chunk_grid"]["configuration"]["chunk_shape"])
        self._shape = tuple(about["shape"])
        self._dtype = np.dtype(about["data_type"]).newbyteorder("<")

    @property
    def chunk_rows(self) -> int:
        """The number of rows of a chunk; the last one may have fewer."""
        return int(self._chunk[0])

    def all(self) -> NDArray[Any]:
        """All rows."""
        values = np.empty(self._shape, self._dtype)
        for number in range(ceil(self._shape[0] / self.chunk_rows)):
            values[number * self.chunk_rows :][: self.chunk_rows] = self.rows_of(number)
        return values

    def rows_of(self, number: int) -> NDArray[Any]:
        """The rows of the chunks with a number along the first axis."""
        first = number * self.chunk_rows
        if not 0 <= first < self._shape[0]:
            raise ValueError(f"{self._folder}: has no chunk {number}")
        values = np.empty((min(self.chunk_rows, self._shape[0] - first), *self._shape[1:]), self._dtype)
        grid = [ceil(length / part) for length, part in zip(self._shape[1:], self._chunk[1:], strict=True)]
        for index in np.ndindex(*grid):
            whole = self._read((number, *index))
            place = values[:, *(slice(i * n, (i + 1) * n) for i, n in zip(index, self._chunk[1:], strict=True))]
            place[...] = whole[tuple(slice(0, n) for n in place.shape)]
        return values

    def _read(self, index: tuple[int, ...]) -> NDArray[Any]:
        stored = self._storage.read(f"{self._folder}/{'.'.join(['c', *map(str, index)])}")
        content, checksum = stored[:-_CRC_BYTES], stored[-_CRC_BYTES:]
        if google_crc32c.value(content).to_bytes(_CRC_BYTES, "little") != checksum:
            raise ValueError(f"{self._folder}: is damaged")
        raw = numcodecs.blosc.decompress(content) if self._is_compressed else content
        return np.frombuffer(raw, self._dtype).reshape(self._chunk)
