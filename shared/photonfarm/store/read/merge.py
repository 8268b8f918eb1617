"""The passes of a view merged into one image: exactly, and whatever the order and the grouping.

Shape letters: H W image.

Every stored value is a float16 times a power of two or a float32, so a whole multiple of 2^-149; its square is one of
2^-298, and exact in float64 (24 + 24 ≤ 53 bits, and 2^-298 … 2^256 is in its range). Sums of both are kept as whole
numbers, cut into limbs of 32 bits: limb i counts multiples of 2^(32 i). A value is cut by division and truncation,
which are exact for powers of two, and adds less than 2^32 to a limb of int64, which so has room for 2^31 values. Whole
numbers add exactly, in any order: merged images are equal bit for bit, and no value ever was rounded. Limbs that
nothing has reached are not there: of an ordinary image there are two for the sums and three or four for the squares.

Only the results are rounded, once: with n estimates, S₁ = Σ x and S₂ = Σ x², the mean S₁ / n and M2 = Σ (x − mean)²
= (n S₂ − S₁²) / n are quotients of whole numbers, and Python's division rounds these correctly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import read_arrays, write_arrays
from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.core.records import F32
from photonfarm.store.model.scene_store import SceneStore
from photonfarm.store.read.batch import Batch
from photonfarm.store.read.find import Query, SceneMatch
from photonfarm.store.read.reader import SceneReader

F64 = NDArray[np.float64]

_BITS = 32
_LOWEST = -10
"""The limb of 2^-320, below which no square of a float32 reaches."""

_AT_ONCE = 1 << 15
"""The number of pixels divided at a time: Python's whole numbers take some 100 bytes each."""


@dataclass(frozen=True, slots=True, eq=False)
class MergedView:
    """One view, estimated from all of its merged passes; linear radiance, unscaled."""

    passes: int
    mean: F64  # (H, W, 3) of all 2 · passes halves
    m2: F64  # (H, W, 3) sum of the squared differences from `mean`
    half_a: F64  # (H, W, 3) mean of the halves A, independent of…
    half_b: F64  # (H, W, 3) …the mean of the halves B: what `photonfarm.core.statistics` takes

    @property
    def count(self) -> int:
        """The number of independent estimates in `mean`."""
        return 2 * self.passes

    @property
    def standard_error(self) -> F64:
        """The standard error of `mean`, (H, W, 3): √(M2 / (n (n − 1))); itself an estimate, rough from few passes."""
        return np.sqrt(self.m2 / (self.count * (self.count - 1)))

    def write(self, file: str | Path) -> None:
        """Store it as a NumPy archive of its fields, with `standard_error`, whole or not at all; make its folder too.

        Raises ValueError for a name without .npz, which NumPy would append, and StoreError if the disk refuses.
        """
        if (path := Path(file)).suffix != ".npz":
            raise ValueError(f"{file}: a merged view is written as a NumPy archive; give it a name that ends in .npz")
        write_arrays(path, asdict(self) | {"standard_error": self.standard_error}, "merged view")

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read what `write` stored; raises StoreError for anything else."""
        with read_arrays(file, "merged view", "store merge") as stored:
            images = (np.asarray(stored[name]) for name in ("mean", "m2", "half_a", "half_b"))
            return cls(int(stored["passes"]), *images)


@dataclass(frozen=True, slots=True)
class WrittenView:
    """A merged view in a file of its own, in figures."""

    view: str  # its content key
    passes: int
    mean: float  # of all values
    standard_error: float  # of a value, as the root of its mean square
    file: str


class Moments:
    """Exact sums over passes of one view."""

    def __init__(self) -> None:
        """Begin without passes."""
        self.passes = 0
        self._shape: tuple[int, ...] = ()  # (H, W, 3)
        self._sums: _Limbs = {}  # (2, H, W, 3), by half
        self._squares: _Limbs = {}  # (H, W, 3)

    def add(self, halves: F32) -> None:
        """Add one pass, (2, H, W, 3); raises ValueError for a value that is not finite, or another size of image."""
        if not np.isfinite(halves).all():
            raise ValueError("a pass holds values that are not finite; it has no exact sum")
        self._shape = self._shape or halves.shape[1:]
        if halves.shape[1:] != self._shape:
            raise ValueError(f"a pass of shape {halves.shape} does not add to images of shape {self._shape}")
        self.passes += 1
        exact = halves.astype(np.float64)
        _add_exactly(self._sums, exact)
        for half in exact:
            _add_exactly(self._squares, half * half)

    def merged(self) -> MergedView:
        """The image; raises ValueError without passes."""
        if not self.passes:
            raise ValueError("no pass to merge")
        images = np.empty((4, int(np.prod(self._shape))))
        for start in range(0, images.shape[1], _AT_ONCE):
            at = slice(start, start + _AT_ONCE)
            images[:, at] = self._quotients(at)
        mean, m2, half_a, half_b = images.reshape(4, *self._shape)
        return MergedView(self.passes, mean, m2, half_a, half_b)

    def _quotients(self, at: slice) -> list[list[float]]:
        """Mean, M2, A and B of some values: whole numbers are multiples of 2^(32 · _LOWEST)."""
        n, unit = self.passes, 1 << (-_BITS * _LOWEST)
        (a, b), (squares,) = _whole(self._sums, 2, at), _whole(self._squares, 1, at)
        both = a + b
        m2 = (2 * n * squares * unit - both * both).tolist()
        return [
            [total / (2 * n * unit) for total in both.tolist()],
            [total / (2 * n * unit * unit) for total in m2],
            [total / (n * unit) for total in a.tolist()],
            [total / (n * unit) for total in b.tolist()],
        ]


_Limbs = dict[int, NDArray[np.int64]]
"""A sum of arrays of float64 whose values are multiples of 2^-320, below 2^288: see the top of this file."""


def _add_exactly(limbs: _Limbs, values: F64) -> None:
    """Add one array to a sum."""
    rest = values
    while (largest := float(np.abs(rest).max(initial=0.0))) > 0:
        limb = (int(np.frexp(largest)[1]) - 1) // _BITS
        whole = np.trunc(np.ldexp(rest, -_BITS * limb))
        limbs[limb] = limbs.get(limb, 0) + whole.astype(np.int64)
        rest = rest - np.ldexp(whole, _BITS * limb)


def _whole(limbs: _Limbs, images: int, at: slice) -> NDArray[Any]:
    """A part of each image of a sum as Python's whole numbers, multiples of 2^(32 · _LOWEST)."""
    total: Any = np.zeros((images, 1), object)
    for limb, counts in limbs.items():
        total = total + (counts.reshape(images, -1)[:, at].astype(object) << (_BITS * (limb - _LOWEST)))
    return np.asarray(total)


# ------------------------------------------------------------------------------------------------------------- a reader


def merge_view(reader: SceneReader, view_row: int) -> MergedView:
    """All passes of a view that were complete at the reader's last refresh, one at a time in memory.

    Raises StoreError if there is none, CorruptError for bytes that are not what was committed.
    """
    rows = reader.rows_of_view(view_row).tolist()
    if not rows:
        raise StoreError(f"view row {view_row} has no complete pass yet")
    moments, memory = Moments(), Batch.empty(reader.spec, 1, buffers=False)
    for row in rows:
        try:
            moments.add(reader.read_batch([row], memory).linear(0))
        except ValueError as error:
            raise CorruptError(f"row {row}: {error}") from error
    return moments.merged()


def merge_views(scene: SceneStore, query: Query, least: int = 1) -> Iterator[tuple[str, MergedView]]:
    """The views of the samples that match a query: their content keys, and all complete passes of each.

    A view needs one complete sample that matches, and at least `least` complete passes.
    """
    reader = SceneReader(scene.storage.where, scene.scene_id)
    complete = set(reader.refresh().tolist())
    rows = [row for row in SceneMatch(scene, query).rows.tolist() if row in complete]
    views = {reader.view_row(row): row for row in reversed(rows)}  # each view's first row stays
    for view_row, row in sorted(views.items()):
        if len(reader.rows_of_view(view_row)) < least:
            continue
        yield reader.view_key(row).hex(), merge_view(reader, view_row)


def write_views(views: Iterable[tuple[str, MergedView]], folder: Path) -> Iterator[WrittenView]:
    """Write merged views, given with their content keys, into a folder, which is made; yields each once it is written.

    Raises StoreError if the disk refuses.
    """
    for key, view in views:
        file = folder / f"{key}.npz"
        view.write(file)
        error = float((view.standard_error**2).mean() ** 0.5)
        yield WrittenView(key, view.passes, float(view.mean.mean()), error, str(file))
