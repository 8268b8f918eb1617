"""Content keys and the seeds that follow from them.

A key is a BLAKE2b hash of 16 bytes over typed, length-prefixed parts. Seeds and random streams are functions
of a key and a purpose, so that no order of work, no worker and no clock enters what is rendered. Seed 0 is a seed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Key: TypeAlias = bytes
"""16 bytes."""

Part: TypeAlias = str | int | float | bytes | NDArray[np.float32] | NDArray[np.bool_]

KEY_BYTES = 16


def make_key(*parts: Part) -> Key:
    """The content key of a sequence of parts; equal parts in equal order give equal keys, on every machine."""
    tagged = (_encode(part) for part in parts)
    content = b"".join(tag + len(data).to_bytes(8, "little") + data for tag, data in tagged)
    return hashlib.blake2b(content, digest_size=KEY_BYTES).digest()


def view_key(modification_key: Key, view: NDArray[np.float32]) -> Key:
    """The content key of a view of a configuration; `view` is the view's vector (D,)."""
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


AT_ONCE = 512
"""The number of streams that are drawn from at a time, so that intermediate results stay in the processor's cache."""

_MULTIPLIERS = (np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157))
_INCREMENTS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B))
_HALF, _MASK = np.uint64(32), np.uint64(0xFFFFFFFF)


def uniform_of(keys: Sequence[Key], purpose: str, count: int, first: int = 0) -> NDArray[np.float64]:
    """`count` numbers of the stream of each key (N, count), after its `first` ones, as `Stream` has them.

    A generator of numpy for each key would take minutes for a million.
    """
    uniform = np.empty((len(keys), count))
    begin, end = first // 4, -(-(first + count) // 4)  # blocks of four words
    for start in range(0, len(keys), AT_ONCE):
        chunk = keys[start : start + AT_ONCE]
        words = np.frombuffer(b"".join(make_key(key, purpose) for key in chunk), "<u8").reshape(-1, 2)
        raw = _philox(words.astype(np.uint64), begin, end).transpose(2, 0, 1).reshape(len(chunk), 4 * (end - begin))
        raw = raw[:, first - 4 * begin :][:, :count]
        uniform[start : start + AT_ONCE] = (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return uniform


def _philox(keys: NDArray[np.uint64], begin: int, end: int) -> NDArray[np.uint64]:
    """Blocks of words of Philox 4x64-10 for each key (N, 2), as (end − begin, 4, N)."""
    counters = np.arange(begin + 1, end + 1, dtype=np.uint64)[:, None]  # numpy counts before it draws
    a = np.repeat(counters, len(keys), axis=1)
    b, c, d = (np.zeros_like(a) for _ in range(3))
    key_0, key_1 = keys[:, 0], keys[:, 1]
    for _ in range(10):
        high_a, low_a = _product(a, _MULTIPLIERS[0])
        high_c, low_c = _product(c, _MULTIPLIERS[1])
        a, b, c, d = high_c ^ b ^ key_0, low_c, high_a ^ d ^ key_1, low_a
        key_0, key_1 = key_0 + _INCREMENTS[0], key_1 + _INCREMENTS[1]  # modulo 2^64
    return np.stack([a, b, c, d], axis=1)


def _product(a: NDArray[np.uint64], b: np.uint64) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """The upper and the lower 64 bits of a · b, by halves of 32 bits."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _MASK, b >> _HALF, b & _MASK
    cross = a_high * b_low + (a_low * b_low >> _HALF)
    middle = a_low * b_high + (cross & _MASK)
    return a_high * b_high + (cross >> _HALF) + (middle >> _HALF), a * b
