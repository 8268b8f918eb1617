"""Tests of the halves of all samples together: repeated seeds, and a half that differs systematically.

Shape letters: H W image, T tests.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from math import log, sqrt
from typing import Any

import numpy as np
from awscrt.checksums import crc32c  # type: ignore[import-untyped]
from numpy.typing import NDArray

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
    standard_error: float  # of `difference`; 0 for a single sample
    allowed: float  # how far `difference` may be from 0 by chance, as `statistic` may be up to `limit`

    @property
    def passed(self) -> bool:
        """Whether nothing differs by more than chance allows."""
        return self.statistic < self.limit

    @property
    def is_conclusive(self) -> bool:
        """Whether there are enough samples for a difference to show: |S| is √n at most."""
        return sqrt(self.samples) >= self.limit


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
        mean = float(self._sum[-1] / n)
        variance = max(float(self._squares[-1] / n) - mean**2, 0.0)
        error = sqrt(variance / (n - 1)) if n > 1 else 0.0
        limit = sqrt(2 * log(2 * self._tests / SIGNIFICANCE))
        allowed = limit * sqrt(float(self._squares[-1])) / n
        return HalvesResult(n, float(abs(s[place])), limit, where, mean, error, allowed)


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
