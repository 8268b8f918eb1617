"""Reading single rows from shards: the same standard files as zarr reads, an order of magnitude faster.

A shard (Zarr v3 `sharding_indexed`, index at the end) is the inner chunks in any order, then per inner chunk its offset
and length as little-endian uint64 (both 2^64 − 1 for an empty one), then the CRC-32C of that index. Each inner chunk
is its bytes, compressed or not, then their CRC-32C. zarr-python is the oracle of the tests.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import google_crc32c
import numcodecs.blosc  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.errors import CorruptError
from photonfarm.shared.store.schema import ArraySchema

_EMPTY = 2**64 - 1
_CRC_BYTES = 4


def read_row(path: Path, schema: ArraySchema, shard_rows: int, row: int) -> NDArray[Any] | None:
    """Row `row` of a shard, of the schema's row shape and type; None if that row is not written.

    Every byte returned has been checked. Raises CorruptError, with the file's name, for a missing, cut or damaged file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError as error:
        raise CorruptError(f"{path}: is committed, but missing") from error
    try:
        index = _read_index(descriptor, path, shard_rows)
        return _read_chunk(descriptor, path, schema, row, *index[row].tolist())
    finally:
        os.close(descriptor)


def _read_index(descriptor: int, path: Path, shard_rows: int) -> NDArray[np.uint64]:
    size = os.fstat(descriptor).st_size
    wanted = 16 * shard_rows + _CRC_BYTES
    if size < wanted:
        raise CorruptError(f"{path}: has {size} bytes, too few for the index of {shard_rows} rows")
    index = _checked(os.pread(descriptor, wanted, size - wanted), path, "the index")
    return index.view("<u8").reshape(shard_rows, 2)


def _read_chunk(
    descriptor: int, path: Path, schema: ArraySchema, row: int, offset: int, length: int
) -> NDArray[Any] | None:
    if offset == _EMPTY:
        return None
    data = _checked(os.pread(descriptor, length, offset), path, f"row {row} of the shard")
    if schema.compressed:
        data = numcodecs.blosc.decompress(data)
    return np.frombuffer(data, schema.dtype).reshape(schema.shape)


def _checked(data: bytes, path: Path, what: str) -> NDArray[np.uint8]:
    """The data before its checksum; a cut file fails like a damaged one."""
    content = np.frombuffer(data, np.uint8)[:-_CRC_BYTES]
    if google_crc32c.value(content) != int.from_bytes(data[-_CRC_BYTES:], "little"):
        raise CorruptError(f"{path}: {what} fails its CRC-32C; the stored bytes are not what was committed")
    return content
