"""The check of stored values: images and views that are certainly or probably wrong, of one sample and of all together.

Shape letters: H W image, T tests.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import ceil, log, sqrt
from typing import Any

import numpy as np
from awscrt.checksums import crc32c  # type: ignore[import-untyped]
from numpy.typing import NDArray

from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.store.format.schema import bit_counts
from photonfarm.store.model.findings import Cause

_FLOAT = {2: (np.uint16, 0x7FFF, 0x7C00), 4: (np.uint32, 0x7FFFFFFF, 0x7F800000)}
"""The integer type, the mask of the magnitude and the magnitude of infinity, by the bytes of a float."""


BLOCKS = 8
"""Blocks along each side of an image, whose sides are multiples of 8."""

SIGNIFICANCE = 1e-6
"""The largest probability of reporting different halves in a store without a fault, over all tests of a check."""


@dataclass(frozen=True, slots=True)
class HalvesResult:
    """Whether A and B are distributed alike."""

    samples: int
    statistic: float  # the largest |S| over all blocks and the whole image
    limit: float  # what |S| reaches by chance with probability SIGNIFICANCE at most, over all tests together
    where: str  # the block of the largest |S|, or the whole image
    difference: float  # mean over the samples of (A − B) / (A + B) of whole images
    allowed: float  # how far `difference` may be from 0 by chance, as `statistic` may be up to `limit`

    @property
    def passed(self) -> bool:
        """Whether nothing differs by more than chance allows."""
        return self.statistic < self.limit

    @property
    def in_words(self) -> str:
        """The outcome, in words; there may be too few samples for a difference to show, as |S| is √n at most."""
        verdict = "no difference beyond chance" if self.passed else "they differ by more than chance"
        if sqrt(self.samples) < self.limit:
            verdict = f"too few samples to tell, {ceil(self.limit**2)} are needed at least"
        return (
            f"{verdict}: |S| = {self.statistic:.2f} in {self.where}, {'below' if self.passed else 'above'} "
            f"{self.limit:.2f}, which chance reaches with probability {SIGNIFICANCE:g} at most; of whole images "
            f"(A − B)/(A + B) = {self.difference:+.2%}, and chance allows ± {self.allowed:.2%} over {self.samples} "
            "samples"
        )


class HalvesTest:
    """A sign-symmetry test between A and B for each block and for the whole image; takes one sample at a time.

    If A and B are independent and distributed alike, as they are whatever the scene, then d = (a − b) / (a + b) of
    their means over a block is as likely as −d, for each sample by itself. So S = Σd / √Σd² exceeds x in absolute value
    with a probability of at most 2·exp(−x²/2) (Hoeffding's inequality for the random signs, given all |d|; Efron,
    "Student's t-test under symmetry conditions", 1969). That is exact for any number of samples and whatever their
    noise, where a z-test of so many samples would need their mean's error to be normal, which fireflies forbid. The
    price: |S| ≤ √n, so that no fewer than `limit`² samples can fail (about 40). Bonferroni's correction for T tests.
    """

    def __init__(self, scenes: int = 1) -> None:
        """Begin without samples; the significance is shared with the tests of other scenes."""
        self.scenes = scenes
        self._tests = scenes * (BLOCKS * BLOCKS + 1)
        self._samples = 0
        self._sum, self._squares = np.zeros((2, BLOCKS * BLOCKS + 1))

    def add(self, halves: NDArray[Any]) -> None:
        """Add a sample, (2, H, W, 3) of any float type and scale; samples that are not finite count as equal halves."""
        _, height, width, _ = halves.shape
        wide = halves.astype(np.float32 if halves.dtype == np.float16 else np.float64)
        rows = wide.reshape(2, BLOCKS, height // BLOCKS, width * 3).sum(axis=2)
        blocks = rows.reshape(2, BLOCKS * BLOCKS, -1).sum(axis=2, dtype=np.float64)
        a, b = np.concatenate([blocks, blocks.sum(axis=1, keepdims=True)], axis=1)
        size = np.abs(a) + np.abs(b)
        d = np.divide(a - b, size, out=np.zeros_like(size), where=(size > 0) & np.isfinite(size))
        self._samples += 1
        self._sum += d
        self._squares += d**2

    def merge(self, other: HalvesTest) -> None:
        """Add the samples of another test of the same scene."""
        self._samples += other._samples
        self._sum += other._sum
        self._squares += other._squares

    def result(self) -> HalvesResult | None:
        """The test over all samples added; None if there are none."""
        n = self._samples
        if not n:
            return None
        s = np.divide(self._sum, np.sqrt(self._squares), out=np.zeros_like(self._sum), where=self._squares > 0)
        place = int(np.argmax(np.abs(s)))
        y, x = divmod(place, BLOCKS)
        where = "the whole image" if place == BLOCKS * BLOCKS else f"block x {x}, y {y} of {BLOCKS} × {BLOCKS}"
        limit = sqrt(2 * log(2 * self._tests / SIGNIFICANCE))
        allowed = limit * sqrt(float(self._squares[-1])) / n
        return HalvesResult(n, float(abs(s[place])), limit, where, float(self._sum[-1] / n), allowed)


class Fingerprints:
    """Finds halves that may be equal among all samples, by 64 bits of each: 32 bytes a sample."""

    def __init__(self) -> None:
        self._prints, self._rows = array("Q"), array("q")

    def add(self, row: int, half: NDArray[Any]) -> int:
        """Add one half of a sample, contiguous; returns its fingerprint: CRC-32C of the first and the second part."""
        content = np.ravel(half).view(np.uint8)
        middle = len(content) // 2
        fingerprint = int(crc32c(content[:middle])) << 32 | int(crc32c(content[middle:]))
        self._prints.append(fingerprint)
        self._rows.append(row)
        return fingerprint

    def merge(self, other: Fingerprints) -> None:
        """Add the halves of other samples."""
        self._prints.extend(other._prints)
        self._rows.extend(other._rows)

    def suspects(self) -> Iterator[list[int]]:
        """The rows of two or more samples whose halves have equal fingerprints, once for each fingerprint."""
        prints, rows = np.array(self._prints, np.uint64), np.array(self._rows, np.int64)
        order = np.argsort(prints, kind="stable")
        prints, rows = prints[order], rows[order]
        begin = np.flatnonzero(np.concatenate([[True], prints[1:] != prints[:-1]])) if len(prints) else prints[:0]
        end = np.append(begin[1:], len(prints))
        for i in np.flatnonzero(end - begin > 1):
            distinct = np.unique(rows[begin[i] : end[i]])
            if len(distinct) > 1:
                yield distinct.tolist()


@dataclass(slots=True)
class CheckTotals:
    """Totals over jobs of a scene."""

    halves: HalvesTest
    fingerprints: Fingerprints = field(default_factory=Fingerprints)
    counts: Counter[str] = field(default_factory=Counter)  # as `Figures` has them, of what could be read
    jobs: int = 0
    samples: int = 0
    size_bytes: int = 0

    def add(self, other: CheckTotals) -> None:
        """Add the totals of other jobs of the scene."""
        self.halves.merge(other.halves)
        self.fingerprints.merge(other.fingerprints)
        self.counts.update(other.counts)
        for name in ("jobs", "samples", "size_bytes"):
            setattr(self, name, getattr(self, name) + getattr(other, name))


def check_radiance(row: int, halves: NDArray[Any], totals: CheckTotals) -> Iterator[tuple[Cause, str]]:
    """Check the halves of a sample, (2, H, W, 3), whose values are finite and scaled as they are stored."""
    totals.samples += 1
    totals.halves.add(halves)
    black = [half for half, values in zip("AB", halves, strict=True) if not largest(values)]
    totals.counts.update(samples=1, black=int(len(black) == 2))
    prints = [totals.fingerprints.add(row, values) for values in halves if largest(values)]
    if not prints:
        yield Cause.BLACK, "all zero"
    elif black:
        yield Cause.BLACK_HALF, f"{black[0]} is all zero"
    elif prints[0] == prints[-1] and np.array_equal(*halves) and not is_constant(halves[0]):
        yield Cause.EQUAL_HALVES, "A = B in every pixel"


def check_view(
    depth: NDArray[Any], normal: NDArray[Any], view: View | None, spec: SceneSpec
) -> Iterator[tuple[Cause, str]]:
    """Check the buffers of a view: depth (H, W) and the modelled normals (H, W, 3).

    Normals are not turned to the camera, so the inside of a box or the back of a leaf is rightly seen from behind, and
    so are all of them from inside an object. A view is reported if it shows nothing else.
    """
    hit = depth > 0
    if not hit.any():
        yield Cause.EMPTY_VIEW, "depth is 0 in every pixel"
    elif view is not None:
        cosine = (Camera.of(view, spec).rays() * normal.astype(np.float32)).sum(axis=-1)  # (H, W) above 0: from behind
        if (cosine[hit] > 0).all():
            yield Cause.BACK_FACING, f"all {np.count_nonzero(hit)} pixels that meet something"


def check_bits(name: str, packed: NDArray[np.uint8], spec: SceneSpec) -> Iterator[tuple[Cause, str]]:
    """Check the stored bits of which points or photons a view sees: `point_seen` or `photon_seen`."""
    count = bit_counts(spec)[name]
    if count % 8 and packed[-1] >> count % 8:
        yield Cause.UNUSED_BIT, f"{name} has a bit above those of {count}"


def is_constant(half: NDArray[Any]) -> bool:
    """Whether all pixels of an image (H, W, 3) are equal: it then has no noise, and does not depend on the seed."""
    return bool((half == half[0, 0]).all())


def is_finite(values: NDArray[Any]) -> bool:
    """Whether no value of an array of floats is NaN or infinite."""
    return largest(values) < _FLOAT[values.dtype.itemsize][2]


def largest(values: NDArray[Any]) -> int:
    """The bits of the largest magnitude in an array of floats, 0 if all are zero; NaN is above infinity."""
    bits, magnitude, _ = _FLOAT[values.dtype.itemsize]
    return int((values.view(bits) & bits(magnitude)).max())
