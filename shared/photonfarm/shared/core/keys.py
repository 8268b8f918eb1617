"""Content keys and the seeds that follow from them.

A key is a BLAKE2b hash of 16 bytes over typed, length-prefixed parts. Seeds and random streams are functions
of a key and a purpose, so that no order of work, no worker and no clock enters what is rendered. Seed 0 is a seed.
"""

from __future__ import annotations

import hashlib
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Key: TypeAlias = bytes
"""16 bytes."""

Part: TypeAlias = str | int | float | bytes | NDArray[np.float32] | NDArray[np.bool_]

KEY_BYTES = 16


def make_key(*parts: Part) -> Key:
    """The content key of a sequence of parts; equal parts in equal order give equal keys, on every machine."""
    return key_of(encoded(*parts))


def encoded(*parts: Part) -> bytes:
    """The bytes that stand for a sequence of parts; those of a longer sequence begin with them."""
    tagged = (_encode(part) for part in parts)
    return b"".join(tag + len(data).to_bytes(8, "little") + data for tag, data in tagged)


def key_of(encoded_parts: bytes) -> Key:
    """The content key of parts that are encoded already."""
    return hashlib.blake2b(encoded_parts, digest_size=KEY_BYTES).digest()


def view_key(modification_key: Key, view: NDArray[np.float32]) -> Key:
    """The content key of a view of a configuration; `view` is the view's vector (6,)."""
    return make_key("view", modification_key, view)


def _encode(part: Part) -> tuple[bytes, bytes]:
    match part:
        case str():
            return b"s", part.encode()
        case bytes():
            return b"b", part
        case int():
            return b"i", str(int(part)).encode()
        case float():
            return b"f", np.float64(part).tobytes()
        case np.ndarray():
            little = np.ascontiguousarray(part, part.dtype.newbyteorder("<"))
            return b"a", f"{little.dtype.str}{little.shape}".encode() + little.tobytes()
    raise TypeError(f"a key part must be str, int, float, bytes or an array, not {type(part).__name__}")


def seed_of(key: Key, purpose: str) -> int:
    """A 32-bit seed for one purpose ("half A", "photons", …) of what `key` names."""
    return int.from_bytes(make_key(key, purpose)[:4], "little")


class Stream:
    """Uniform random numbers from a counter-based generator (Philox 4x64; Salmon et al., SC 2011).

    Made from the raw 64-bit words, so that the numbers do not depend on the version of numpy.
    """

    def __init__(self, key: Key, purpose: str) -> None:
        words = np.frombuffer(make_key(key, purpose), "<u8")
        self._bits = np.random.Philox(key=words)

    def uniform(self, *shape: int) -> NDArray[np.float64]:
        """Numbers in [0, 1) of the given shape; a multiple of 2^-53 each."""
        raw = self._bits.random_raw(int(np.prod(shape)))
        return (raw >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53

    def uniform_in(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        """One point uniform in the axis-aligned box [low, high]; a flat axis gives its one value exactly."""
        return low + self.uniform(*low.shape) * (high - low)
