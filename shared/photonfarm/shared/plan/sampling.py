"""Many configurations and views at once: bit by bit what `sample_modification` and `sample_view` draw one by one.

Those two define what is drawn; a plan of a million samples would spend minutes in them. Here the keys are hashed in one
pass over bytes, and the random words of all streams come from one vectorised generator.

Shape letters: N items, G movable groups.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Key, encoded, key_of
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.modification import Modification, rest
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import MOST_DRAWS, in_free_space, nowhere, sample_view

F64 = NDArray[np.float64]
U64 = NDArray[np.uint64]

_AT_ONCE = 1 << 9
"""The number of streams drawn from at a time, so that intermediate results stay in the processor's cache."""


def modification_vectors(spec: SceneSpec, seed: int, count: int) -> F32:
    """The vectors of configurations 0 … `count` − 1 of a master seed, (N, G, 4)."""
    vectors = np.zeros((count, len(spec.groups), 4), np.float32)
    begin = encoded("modification", spec.scene_id, seed)
    for start in range(0, count, _AT_ONCE):
        end = min(start + _AT_ONCE, count)
        keys = [key_of(begin + encoded(index)) for index in range(start, end)]
        uniform = _uniform(keys, 4 * len(spec.groups))
        for g, group in enumerate(spec.groups):
            place, chance = uniform[:, 4 * g : 4 * g + 3], uniform[:, 4 * g + 3]
            present = chance >= group.removal_probability
            position = group.box.low + place * (group.box.high - group.box.low)
            vectors[start:end, g, :3] = np.where(present[:, None], position - np.array(group.at), 0.0)
            vectors[start:end, g, 3] = present
    return vectors


def modification_keys(spec: SceneSpec, vectors: F32) -> list[Key]:
    """The content keys of configurations (N, G, 4), as `Modification.key` makes them."""
    begin = encoded("modification", spec.scene_id)
    return [key_of(begin + vector) for vector in encoded_rows(vectors)]


def view_keys(modification_keys: list[Key], vectors: F32) -> list[Key]:
    """The content keys of views (N, 6), as `keys.view_key` makes them, of N configurations."""
    begin = encoded("view")
    views = zip(modification_keys, encoded_rows(vectors), strict=True)
    return [key_of(begin + encoded(key) + vector) for key, vector in views]


def view_vectors(
    spec: SceneSpec,
    modification_keys: list[Key],
    seed: int,
    indices: NDArray[np.int64],
    modifications: F32 | None = None,
) -> F32:
    """The vectors of views of configurations, (N, 6): `indices` has the number of each view within its own.

    `modifications` (N, G, 4) are these configurations, by default the scene at rest; only free space needs them.
    """
    vectors = np.empty((len(indices), 6), np.float32)
    begin, of_seed = encoded("view"), encoded(seed)
    number = {index: encoded(index) for index in np.unique(indices).tolist()}
    if modifications is None:
        modifications = np.broadcast_to(rest(spec).vector, (len(indices), len(spec.groups), 4))
    for start in range(0, len(indices), _AT_ONCE):
        end = min(start + _AT_ONCE, len(indices))
        numbers = indices[start:end].tolist()
        keys = [
            key_of(begin + encoded(key) + of_seed + number[index])
            for key, index in zip(modification_keys[start:end], numbers, strict=True)
        ]
        _draw(spec, keys, vectors[start:end], modifications[start:end])
    for i in _looking_at_themselves(spec, vectors):
        configuration = Modification.from_vector(modifications[i])
        vectors[i] = sample_view(spec, modification_keys[i], seed, int(indices[i]), configuration).vector
    return vectors


def _draw(spec: SceneSpec, keys: list[Key], vectors: F32, modifications: F32) -> None:
    """Draw views (N, 6) from the streams of keys, again and again until their origins are in free space.

    Those that look at themselves are left to `sample_view`.
    """
    low = np.concatenate([spec.view.origin.low, spec.view.look_at.low])
    high = np.concatenate([spec.view.origin.high, spec.view.look_at.high])
    left = np.arange(len(keys))
    for draw in range(MOST_DRAWS):
        vectors[left] = low + _uniform([keys[i] for i in left.tolist()], 6, first=6 * draw) * (high - low)
        done = in_free_space(spec, vectors[left, :3], modifications[left])
        if not done.all():
            done[_looking_at_themselves(spec, vectors[left])] = True
        left = left[~done]
        if not len(left):
            return
    raise nowhere(spec)


def _looking_at_themselves(spec: SceneSpec, vectors: F32) -> list[int]:
    """The views whose look-at point is so near, give or take rounding, that `sample_view` may draw it again."""
    boxes = (spec.view.origin, spec.view.look_at)
    diagonal = np.linalg.norm(np.max([b.high for b in boxes], axis=0) - np.min([b.low for b in boxes], axis=0))
    apart = np.linalg.norm(vectors[:, 3:].astype(np.float64) - vectors[:, :3], axis=1)
    return np.flatnonzero(apart < 1.001e-4 * diagonal).tolist()


def sample_keys(scene_id: str, modifications: F32, views: F32, passes: NDArray[np.int32]) -> list[Key]:
    """The content keys of samples, as `plan.sample_key` makes them; (N, G, 4), (N, 6), (N,)."""
    begin = encoded("sample", scene_id)
    number = {pass_: encoded(pass_) for pass_ in np.unique(passes).tolist()}
    rows = zip(encoded_rows(modifications), encoded_rows(views), passes.tolist(), strict=True)
    return [key_of(begin + modification + view + number[pass_]) for modification, view, pass_ in rows]


def encoded_rows(array: F32) -> Iterator[bytes]:
    """Each row of an array as a part of a key."""
    if len(array):
        head = encoded(array[0])[: -array[0].nbytes or None]  # a static scene has 0 groups
        yield from (head + row for row in contents(array))


def contents(array: F32) -> Iterator[bytes]:
    """The bytes of each row of an array, little-endian."""
    data, size = np.ascontiguousarray(array, "<f4").tobytes(), array[0].nbytes if len(array) else 0
    return (data[i * size : (i + 1) * size] for i in range(len(array)))


# ------------------------------------------------------------------------------------------------------------ streams


def _uniform(keys: list[Key], count: int, first: int = 0) -> F64:
    """`count` numbers of the stream "placement" of each key, after its `first` ones, in [0, 1); (N, count).

    See `keys.Stream`.
    """
    purpose = encoded("placement")
    words = np.frombuffer(b"".join(key_of(encoded(key) + purpose) for key in keys), "<u8").reshape(-1, 2)
    begin = first // 4
    blocks = _philox(words.astype(np.uint64), begin, -(-(first + count) // 4))
    raw = blocks.transpose(2, 0, 1).reshape(len(keys), -1)[:, first - 4 * begin :][:, :count]
    return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53


_MULTIPLIERS = (np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157))
_INCREMENTS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B))


def _philox(keys: U64, begin: int, end: int) -> U64:
    """Blocks of words of Philox 4x64-10 for each key (N, 2), as (end − begin, 4, N) [Salmon et al., SC 2011]."""
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


_HALF, _MASK = np.uint64(32), np.uint64(0xFFFFFFFF)


def _product(a: U64, b: np.uint64) -> tuple[U64, U64]:
    """The upper and the lower 64 bits of a · b, by halves of 32 bits."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _MASK, b >> _HALF, b & _MASK
    cross = a_high * b_low + (a_low * b_low >> _HALF)
    middle = a_low * b_high + (cross & _MASK)
    return a_high * b_high + (cross >> _HALF) + (middle >> _HALF), a * b
