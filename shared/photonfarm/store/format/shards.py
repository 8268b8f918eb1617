"""Writes and reads shards row by row: the same standard files as zarr-python's, without its cost per row.

A shard (Zarr v3 `sharding_indexed`, index at the end) is the inner chunks in any order, then per inner chunk its offset
and length as little-endian uint64 (both 2^64 − 1 for an empty one), then the CRC-32C of that index. Each inner chunk
is its bytes, compressed or not, then their CRC-32C. The tests compare with zarr-python and tensorstore.

The end of the module says what becomes of values that are stored in fewer bits.
"""

from __future__ import annotations

import errno
import os
import weakref
from pathlib import Path
from typing import Any

import numcodecs.blosc  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.core.records import F32
from photonfarm.store.format.schema import BLOSC, ArraySchema

_EMPTY = 2**64 - 1
_CRC_BYTES = 4
_BLOSC_HEADER_BYTES = 16
_FLUSH_BYTES = 4 << 20
"""The bytes after which the disk is asked to write them, so that little is left to the sync of a commit."""

OPEN_SHARDS = 400
"""The most shards that a reader keeps open, with a file descriptor each; a usual limit is 1024."""

_DAMAGED = (errno.EIO, errno.EBADMSG, errno.EUCLEAN)
"""The errors of a file system for a file that exists but is damaged: a disk error, or a wrong checksum of its own."""


def encode(array: ArraySchema, values: NDArray[Any]) -> memoryview:
    """The stored bytes of one row (the array's row shape), without their checksum."""
    data: Any = np.ascontiguousarray(values, array.dtype)
    if array.compressed:
        name, level = BLOSC["cname"].encode(), BLOSC["clevel"]
        data = numcodecs.blosc.compress(data, name, level, numcodecs.blosc.SHUFFLE, typesize=data.dtype.itemsize)
    return memoryview(data).cast("B")


class ShardWriter:
    """A shard that is being written. Rows may come in any order and may be left out."""

    def __init__(self, part: Path, array: ArraySchema, shard_rows: int) -> None:
        """Begin the file, which must be new."""
        self.part = part
        self._array = array
        self._index = np.full((shard_rows, 2), _EMPTY, "<u8")
        self._checksums: dict[int, bytes] = {}
        self._file = part.open("xb", buffering=0)
        self._size = self._flushed = 0

    def append(self, row: int, content: memoryview) -> None:
        """Write one row as `encode` gave it; raises OSError."""
        self._checksums[row] = crc_of(content)
        self._index[row] = self._size, len(content) + _CRC_BYTES
        self._write(content)
        self._write(self._checksums[row])
        if (fresh := self._size - self._flushed) > _FLUSH_BYTES:
            # begins to write, and does not wait; what is not yet written stays in the page cache
            os.posix_fadvise(self._file.fileno(), self._flushed, fresh, os.POSIX_FADV_DONTNEED)
            self._flushed = self._size

    def finish(self) -> dict[str, Any]:
        """Write the index; returns the file's size, and one checksum over those of its rows and of the index."""
        index = self._index.tobytes()
        self._write(index + crc_of(index))
        self._file.close()
        checksums = b"".join(self._checksums[row] for row in sorted(self._checksums)) + crc_of(index)
        return {"size": self._size, "crc32c": crc_of(checksums).hex()}

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _write(self, data: bytes | memoryview) -> None:
        written = 0
        while written < len(data):  # an unbuffered write may be a short one
            written += self._file.write(data[written:])
        self._size += len(data)


class Shard:
    """A complete shard, open for reading, whose index has been checked. Several threads may use it at once."""

    def __init__(self, path: Path, array: ArraySchema, shard_rows: int) -> None:
        """Open a shard; raises CorruptError, with the file's name, for a missing, cut or damaged file.

        A file that cannot be opened for want of rights or descriptors may be whole: that raises a plain OSError.
        """
        self.path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError as error:
            raise CorruptError(f"{path}: is committed, but missing") from error
        except OSError as error:
            if error.errno in _DAMAGED:
                raise self._refused(error) from error
            raise
        weakref.finalize(self, os.close, self._descriptor)
        self._array = array
        self._size = os.fstat(self._descriptor).st_size
        self._index: list[list[int]] = self._read_index(shard_rows)  # offset and length of each row

    def _read_index(self, shard_rows: int) -> list[list[int]]:
        wanted = 16 * shard_rows + _CRC_BYTES
        if self._size < wanted:
            raise CorruptError(f"{self.path}: has {self._size} bytes, too few for the index of {shard_rows} rows")
        data = bytearray(wanted)
        read = self._read_at(self._size - wanted, data)
        if read < wanted or crc_of(memoryview(data)[:-_CRC_BYTES]) != data[-_CRC_BYTES:]:
            raise self._damaged("the index")
        index = np.frombuffer(data, "<u8", 2 * shard_rows).reshape(shard_rows, 2)
        offset, length = index[(index != _EMPTY).any(axis=1)].T
        space = np.uint64(self._size - wanted)
        raw_bytes = self._array.dtype.itemsize * int(np.prod(self._array.shape)) + _CRC_BYTES
        of_this_array = length >= _CRC_BYTES if self._array.compressed else length == raw_bytes
        if not ((offset <= space) & (length <= space - np.minimum(offset, space)) & of_this_array).all():
            raise CorruptError(f"{self.path}: the index is not damaged, but does not fit the array {self._array.name}")
        rows: list[list[int]] = index.tolist()
        return rows

    def __contains__(self, row: int) -> bool:
        """Whether a row is written."""
        return self._index[row][0] != _EMPTY

    def read(self, row: int) -> NDArray[Any] | None:
        """Read a row, of the array's row shape and type; None if it is not written. Raises CorruptError."""
        if row not in self:
            return None
        values = np.empty(self._array.shape, self._array.dtype)
        self.read_into(row, values)
        return values

    def read_into(self, row: int, values: NDArray[Any]) -> None:
        """Read a written row into a contiguous array of its shape and type.

        Every byte is checked; raises CorruptError, with the file's name, if one is not what was written.
        """
        memory = np.frombuffer(values.data.cast("B"), np.uint8)
        if self._array.compressed:
            self._decompress(self._checked(row), row, memory)
        else:
            self._checked(row, memory)

    def _checked(self, row: int, memory: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """The stored bytes of a row without their checksum, in `memory` if that is given.

        The check is on what is returned: the copy in memory, not the file that it was read from.
        """
        offset, length = self._index[row]
        crc = bytearray(_CRC_BYTES)
        content = np.empty(length - _CRC_BYTES, np.uint8) if memory is None else memory
        if self._read_at(offset, content.data, crc) != length or crc_of(content) != crc:
            raise self._damaged(f"row {row} of the shard")
        return content

    def _read_at(self, offset: int, *memory: memoryview | bytearray) -> int:
        """Read into some memory from an offset; returns how many bytes came. Raises CorruptError if the disk fails."""
        try:
            return os.preadv(self._descriptor, memory, offset)
        except OSError as error:
            raise self._refused(error) from error

    def _decompress(self, content: NDArray[np.uint8], row: int, memory: NDArray[np.uint8]) -> None:
        """Decompress a row. If the sizes in Blosc's header are right, it writes no less and reads no more."""
        sizes = content[4:_BLOSC_HEADER_BYTES].tobytes()
        expected = len(memory).to_bytes(4, "little"), len(content).to_bytes(4, "little")
        if (sizes[:4], sizes[8:]) != expected:
            raise self._damaged(f"row {row} of the shard")
        try:
            numcodecs.blosc.decompress(content, memory)
        except (RuntimeError, ValueError) as error:  # a whole row of another array
            raise self._damaged(f"row {row} of the shard") from error

    def _refused(self, error: OSError) -> CorruptError:
        return CorruptError(f"{self.path}: cannot be read: {error.strerror}")

    def _damaged(self, what: str) -> CorruptError:
        return CorruptError(f"{self.path}: {what} fails its CRC-32C; the stored bytes are not what was committed")

    def summary(self) -> dict[str, Any]:
        """The size and checksum as `ShardWriter.finish` returned them, from the stored checksums."""
        ends = [offset + length for offset, length in self._index if offset != _EMPTY]
        crcs = [bytearray(_CRC_BYTES) for _ in ends]
        for end, crc in zip(ends, crcs, strict=True):
            self._read_at(end - _CRC_BYTES, crc)
        checksum = crc_of(b"".join(crcs) + crc_of(np.array(self._index, "<u8").tobytes()))
        return {"size": os.fstat(self._descriptor).st_size, "crc32c": checksum.hex()}


def crc_of(data: bytes | memoryview | NDArray[np.uint8]) -> bytes:
    """The CRC-32C of contiguous bytes, as it is stored.

    Of the kept libraries with this checksum, the AWS runtime's is ten times as fast as google-crc32c (60 against 6 GB/s
    in the cache) and lets other threads run meanwhile.
    """
    from awscrt.checksums import crc32c  # type: ignore[import-untyped]

    return int(crc32c(data)).to_bytes(_CRC_BYTES, "little")


NOISY_GUIDES = ("direct", "gloss", "point_light")
"""The guides that are sampled, with seeds of their own; they are rounded."""


def scale_to_array(radiance: F32, exponent: int) -> tuple[str, NDArray[Any]]:
    """The array that a sample goes to, and its values: scaled, or unscaled if float16 cannot hold them."""
    with np.errstate(over="ignore", under="ignore"):
        scaled = radiance * np.float32(2.0**exponent)
    return ("radiance", scaled) if stays_finite(scaled, np.dtype(np.float16)) else ("radiance_wide", radiance)


def round_as_stored(radiance: F32, exponent: int) -> F32:
    """Radiance as readers give it once it is stored: rounded to float16 at the store's scale, if that can hold it."""
    name, values = scale_to_array(radiance, exponent)
    return (
        values if name == "radiance_wide" else values.astype(np.float16).astype(np.float32) * np.float32(2.0**-exponent)
    )


def stays_finite(values: NDArray[Any], stored: np.dtype[Any]) -> bool:
    """Whether all values are finite in the type that they are stored in, to which the writer's thread rounds them.

    65504 is the largest float16 and 65520 the first number that rounds to infinity; likewise for float32. NaN is in no
    range.
    """
    if stored.kind != "f":
        return True
    end = {2: 65520.0, 4: 2.0**128 - 2.0**103}[stored.itemsize]
    return -end < float(values.min()) and float(values.max()) < end


def round_to_8_bits(values: NDArray[Any]) -> F32:
    """Numbers rounded to 8 significant bits, to nearest with ties to even; noisy values need no more.

    The two lower bytes are then 0 and take no room once compressed. Finite values must not be within 0.4 % of the
    largest float32.
    """
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    to_even = (bits >> np.uint32(16)) & np.uint32(1)
    kept: F32 = ((bits + np.uint32(0x7FFF) + to_even) & np.uint32(0xFFFF0000)).view(np.float32)
    return kept
