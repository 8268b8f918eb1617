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


def read_plain(storage: Storage, group: str, names: list[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
    """The attributes of a group and the arrays of these names in it, if all are such as we write them, and whole.

    None otherwise: zarr-python reads what it can, and says what is wrong.
    """
    try:
        attributes = json.loads(storage.read(f"{group}/zarr.json"))["attributes"]
        return attributes, {name: _array(storage, f"{group}/{name}") for name in names}
    except (OSError, ValueError, LookupError, TypeError, RuntimeError):
        return None


def _array(storage: Storage, folder: str) -> NDArray[Any]:
    about = json.loads(storage.read(f"{folder}/zarr.json"))
    codecs = [codec["name"] for codec in about["codecs"]]
    endian = about["codecs"][0].get("configuration", {}).get("endian", "little")
    if codecs not in _CODECS or endian != "little" or about["chunk_key_encoding"] != _FLAT:
        raise ValueError(f"{folder}: is not written here")
    chunk = tuple(about["chunk_grid"]["configuration"]["chunk_shape"])
    values = np.empty(about["shape"], np.dtype(about["data_type"]).newbyteorder("<"))
    for index in np.ndindex(*(ceil(length / part) for length, part in zip(values.shape, chunk, strict=True))):
        stored = storage.read(f"{folder}/{'.'.join(['c', *map(str, index)])}")
        content, checksum = stored[:-_CRC_BYTES], stored[-_CRC_BYTES:]
        if google_crc32c.value(content).to_bytes(_CRC_BYTES, "little") != checksum:
            raise ValueError(f"{folder}: is damaged")
        raw = numcodecs.blosc.decompress(content) if "blosc" in codecs else content
        place = values[tuple(slice(i * part, (i + 1) * part) for i, part in zip(index, chunk, strict=True))]
        place[...] = np.frombuffer(raw, values.dtype).reshape(chunk)[tuple(slice(0, n) for n in place.shape)]
    return values
