"""Shards, written and read row by row: the same standard files as zarr's, without its cost per row.

A shard (Zarr v3 `sharding_indexed`, index at the end) is the inner chunks in any order, then per inner chunk its offset
and length as little-endian uint64 (both 2^64 − 1 for an empty one), then the CRC-32C of that index. Each inner chunk
is its bytes, compressed or not, then their CRC-32C. zarr-python and tensorstore are the oracles of the tests.

Files are read, not mapped: a mapped file that is cut, or whose disk fails, ends the process instead of raising.
"""

from __future__ import annotations

import os
import weakref
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
_SYNC_BYTES = 16 << 20
"""Written between two syncs: the last one, which a commit waits for, has little left to do."""


class ShardWriter:
    """One shard on its way to disk. Rows may come in any order and may be left out."""

    def __init__(self, part: Path, array: ArraySchema, shard_rows: int) -> None:
        """Begin the file, which must be new."""
        self.part = part
        self._array = array
        self._index = np.full((shard_rows, 2), _EMPTY, "<u8")
        self._checksums: dict[int, bytes] = {}
        self._file = part.open("xb", buffering=0)
        self._size = self._synced = 0

    def append(self, row: int, values: NDArray[Any]) -> None:
        """Write one row (the array's row shape and type); raises OSError."""
        data: Any = np.ascontiguousarray(values, self._array.dtype)
        if self._array.compressed:
            data = numcodecs.blosc.compress(data, b"lz4", 5, numcodecs.blosc.SHUFFLE, typesize=data.dtype.itemsize)
        content = memoryview(data).cast("B")
        self._checksums[row] = _crc(content)
        self._index[row] = self._size, len(content) + _CRC_BYTES
        self._write(content)
        self._write(self._checksums[row])
        if self._size - self._synced > _SYNC_BYTES:
            os.fdatasync(self._file.fileno())
            self._synced = self._size

    def finish(self) -> dict[str, Any]:
        """Write the index; the file's size, and one checksum over those of its rows and of the index."""
        index = self._index.tobytes()
        self._write(index + _crc(index))
        self._file.close()
        checksums = b"".join(self._checksums[row] for row in sorted(self._checksums)) + _crc(index)
        return {"size": self._size, "crc32c": _crc(checksums).hex()}

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _write(self, data: bytes | memoryview) -> None:
        written = 0
        while written < len(data):  # an unbuffered write may be a short one
            written += self._file.write(data[written:])
        self._size += len(data)


class Shard:
    """One whole shard, open for reading, its index checked. Safe for several threads at once."""

    def __init__(self, path: Path, array: ArraySchema, shard_rows: int) -> None:
        """Open; raises CorruptError, with the file's name, for a missing, cut or damaged file."""
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise CorruptError(f"{path}: is committed, but missing") from error
        weakref.finalize(self, os.close, self._descriptor)
        self.path = path
        self._array = array
        self._index = self._read_index(shard_rows)

    def _read_index(self, shard_rows: int) -> NDArray[np.uint64]:
        size = os.fstat(self._descriptor).st_size
        wanted = 16 * shard_rows + _CRC_BYTES
        if size < wanted:
            raise CorruptError(f"{self.path}: has {size} bytes, too few for the index of {shard_rows} rows")
        index = self._checked(os.pread(self._descriptor, wanted, size - wanted), "the index")
        return np.frombuffer(index, "<u8").reshape(shard_rows, 2)

    def __contains__(self, row: int) -> bool:
        """Whether a row is written."""
        return int(self._index[row, 0]) != _EMPTY

    def read(self, row: int) -> NDArray[Any] | None:
        """A row, of the array's row shape and type; None if it is not written. Raises CorruptError."""
        if row not in self:
            return None
        values = np.empty(self._array.shape, self._array.dtype)
        self.read_into(row, values)
        return values

    def read_into(self, row: int, values: NDArray[Any]) -> None:
        """A written row into an array of its shape and type, contiguous.

        Every byte has been checked; raises CorruptError, with the file's name, if one is not what was written.
        """
        offset, length = (int(n) for n in self._index[row])
        if self._array.compressed:
            self._decompress(os.pread(self._descriptor, length, offset), row, values)
            return
        content, crc = memoryview(values.data).cast("B"), bytearray(_CRC_BYTES)
        read = os.preadv(self._descriptor, [content, crc], offset)
        if read != length or length != len(content) + _CRC_BYTES or _crc(content) != crc:
            raise self._damaged(f"row {row} of the shard")

    def _decompress(self, data: bytes, row: int, values: NDArray[Any]) -> None:
        content = self._checked(data, f"row {row} of the shard")
        try:
            numcodecs.blosc.decompress(content, values)
        except (RuntimeError, ValueError) as error:  # whole, and yet not of this array
            raise self._damaged(f"row {row} of the shard") from error

    def _checked(self, data: bytes, what: str) -> memoryview:
        """The data before its checksum; a cut file fails like a damaged one."""
        content = memoryview(data)[:-_CRC_BYTES]
        if len(data) < _CRC_BYTES or _crc(content) != data[-_CRC_BYTES:]:
            raise self._damaged(what)
        return content

    def _damaged(self, what: str) -> CorruptError:
        return CorruptError(f"{self.path}: {what} fails its CRC-32C; the stored bytes are not what was committed")

    def summary(self) -> dict[str, Any]:
        """Size and checksum as `ShardWriter.finish` gave them, from the checksums that are stored."""
        written = [int(row) for row in np.flatnonzero(self._index[:, 0] != _EMPTY)]
        ends = self._index[written].sum(axis=1)
        crcs = b"".join(os.pread(self._descriptor, _CRC_BYTES, int(end) - _CRC_BYTES) for end in ends)
        checksum = _crc(crcs + _crc(self._index.tobytes()))
        return {"size": os.fstat(self._descriptor).st_size, "crc32c": checksum.hex()}


def _crc(data: bytes | memoryview) -> bytes:
    read_only = np.frombuffer(data, np.uint8)
    read_only.flags.writeable = False  # all that it takes
    return int(google_crc32c.value(read_only)).to_bytes(_CRC_BYTES, "little")
