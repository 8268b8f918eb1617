"""Random numbers: Owen-scrambled Sobol' points, in pairs of dimensions, each with its own scramble.

The points of a *sequence* are stratified together: the samples of one pixel for eye paths, all light paths of an image
for light paths. Point number `index` of pair `dimension` is a point of the (0,2)-sequence of Sobol' whose index and
coordinates are scrambled as Owen does, by hashing (Burley, *Practical Hash-based Owen Scrambling*, JCGT 2020; the
permutation is that of Laine and Karras 2011 with the constants of Vegdahl 2021). So every single point is uniform, and
an estimate from them has the expectation of independent ones; sequences of different seeds, pixels or purposes are
independent of each other.

Seeds enter the kernels as data, so another seed never compiles anything. The sensor's own sampler only sets the default
number of samples per pixel: the two kinds of path would consume it differently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.launches import Launch

LIGHT, EYE, PAIRING, PHOTONS = range(4)

_ULP = 1 / (1 << 24)

SHIFTS = 64
"""The depths of an eye path with a shift of their own; deeper ones use them again, which only correlates them."""


def image_keys(seeds: Sequence[int]) -> Any:
    """The seeds as device data, UInt32 [K]."""
    keys = mi.UInt32(list(seeds))
    dr.make_opaque(keys)  # a single one would be a literal
    return keys


def stream(key: Any, purpose: int, number: Any = 0) -> Any:
    """The sequence (UInt32) of a purpose, of an image or pixel: the Tiny Encryption Algorithm (Zafar et al. 2010)."""
    first, second = mi.sample_tea_32(key, mi.UInt32(purpose), 8)
    return mi.sample_tea_32(first, second ^ number)[0]


@dataclass(slots=True)
class Sampler:
    """A point of a sequence, whose dimensions are read in pairs. Loop state."""

    sequence: Any  # UInt32: which sequence
    index: Any  # UInt32: which point, its bits reversed
    dimension: Any  # UInt32: pairs read so far

    def next_1d(self) -> Any:
        """A number in [0, 1) (Float)."""
        seed = self._next_seed()
        return _unit(_scramble(dr.brev(_scramble(self.index, seed)), _mix(seed)))

    def next_independent(self) -> Any:
        """A number in [0, 1) (Float) that is not stratified, for uses that gain nothing by it."""
        return mi.Float(_mix(self._next_seed() ^ self.index) >> 8) * _ULP

    def next_2d(self) -> Any:
        """A point in [0, 1)² (Point2f)."""
        seed = self._next_seed()
        x = _scramble(self.index, seed)  # the bits of a shuffled index, reversed: Sobol's first coordinate
        index = dr.brev(x)
        first = _mix(seed)
        return mi.Point2f(_unit(_scramble(index, first)), _unit(_scramble(_sobol_1(index), _mix(first))))

    def _next_seed(self) -> Any:
        self.dimension += 1
        return _mix(self.sequence ^ (self.dimension * 0x9E3779B9))


def sampler(sequence: Any, index: Any) -> Sampler:
    """The points ``index`` (UInt32) of the sequences ``sequence`` (UInt32)."""
    return Sampler(mi.UInt32(sequence), dr.brev(index), mi.UInt32(0))


def shifts(seeds: Sequence[int], launch: Launch, connections: int) -> Any:
    """The shifts from eye paths' numbers to those of the light paths they are joined to: UInt32 [K·64·n_C].

    They are uniform below the number of light paths, for each image of a launch, depth and connection.
    """
    table = [
        np.random.default_rng([seed, PAIRING, launch.first_sample]).integers(
            launch.light_paths, size=SHIFTS * connections
        )
        for seed in seeds
    ]
    return mi.UInt32(np.concatenate(table).tolist())  # a list: Dr.Jit compiles again for each alignment of numpy's


def along_curve(lane: Any, n: Any, rng: Sampler) -> Any:
    """A stratified point in [0, 1)² (Point2f) for each of ``n`` lanes; neighbours in number lie close together.

    Lane k gets a uniform point of the k-th piece of Morton's curve, cut into n equal pieces (He and Owen, *Extensible
    grids: uniform sampling on a space filling curve*, 2016). Rays that start alike are traced faster together. The
    place along the curve has 32 bits, and so 16 for each coordinate: the bits below those are independent.
    """
    length = mi.UInt32((mi.Float64(lane) + mi.Float64(rng.next_1d())) * (4294967296.0 / mi.Float64(n)))
    below = mi.Point2f(rng.next_independent(), rng.next_independent())
    cell = mi.Point2f(mi.Float(_every_other_bit(length)), mi.Float(_every_other_bit(length >> 1)))
    return dr.minimum((cell + below) / (1 << 16), dr.one_minus_epsilon(mi.Float))


def _every_other_bit(x: Any) -> Any:
    """The bits of even number, packed together: 16 bits."""
    for shift, bits in ((0, 0x55555555), (1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        x = (x | (x >> shift)) & bits
    return x


def _mix(x: Any) -> Any:
    """A hash of 32 bits (Wellons, *lowbias32*, 2018)."""
    x = mi.UInt32(x)
    x ^= x >> 16
    x *= 0x21F0AAAD
    x ^= x >> 15
    x *= 0xD35A2D97
    return x ^ (x >> 15)


def _scramble(x: Any, seed: Any) -> Any:
    """An Owen scramble of numbers whose bits are reversed: each bit is flipped by a hash of the bits below it."""
    x = x + seed
    x ^= x * 0x6C50B47C
    x ^= x * 0xB82F1E52
    x ^= x * 0xC7AFE638
    return x ^ (x * 0x8D22F6E6)


def _sobol_1(index: Any) -> Any:
    """Sobol's second coordinate, its bits reversed: Pascal's triangle modulo 2 times the bits of the index."""
    x = index
    for shift, bits in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = x ^ ((x >> shift) & bits)
    return x


def _unit(reversed_bits: Any) -> Any:
    return mi.Float(dr.brev(reversed_bits) >> 8) * _ULP
