"""Random numbers: Owen-scrambled Sobol' points, in pairs of dimensions, each with its own scramble.

The points of a *sequence* are stratified together. A sequence is the samples of one pixel for eye paths, all light
paths of an image for light paths, and all pixels of one sample, to pair them with light paths. Point
number `index` of pair `dimension` is a point of the (0,2)-sequence of Sobol', whose index and coordinates are scrambled
by Owen's method, with a hash (Burley, *Practical Hash-based Owen Scrambling*, JCGT 2020; the permutation is that of
Laine and Karras 2011 with the constants of Vegdahl 2021). So every single point is uniform, and an estimate has the
same expectation as from independent points. Sequences of different seeds, pixels or purposes are independent of each
other.

Seeds enter the kernels as data, so a new seed compiles nothing. The sensor's own sampler only sets the default number
of samples per pixel, since the two kinds of path would draw from it differently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.renderer.bdpt.launches import Launch

LIGHT, EYE, PAIRING, PHOTONS, PIXELS, LEARNING, SLOTS = range(7)
"""What a sequence is for, as a part of its seed."""

_ULP = 1 / (1 << 24)  # the step between the numbers in [0, 1) that are made here

SHIFTS = 64
"""The number of depths with a shift of their own; deeper eye vertices reuse them, which only correlates them."""


def image_keys(seeds: Sequence[int]) -> mi.UInt32:
    """The seeds as device data [K]."""
    keys = mi.UInt32(list(seeds))
    dr.make_opaque(keys)  # a single seed would be a literal
    return keys


def stream(key: mi.UInt32, purpose: int, number: mi.UInt32 | int = 0) -> mi.UInt32:
    """The sequence of a key, a purpose and a pixel's or sample's number, by Tiny Encryption (Zafar et al. 2010)."""
    first, second = mi.sample_tea_32(key, mi.UInt32(purpose), 8)
    return mi.sample_tea_32(first, second ^ number)[0]


class RandomNumbers(Protocol):
    """A source of random numbers, as the choice of a light uses it."""

    def next_1d(self) -> mi.Float:
        """A number in [0, 1)."""

    def next_2d(self) -> mi.Point2f:
        """A point in [0, 1)²."""


@dataclass(slots=True)
class Sampler:
    """A point of a sequence, whose pairs of dimensions are read one after the other; part of the loops' state."""

    sequence: mi.UInt32  # the number of the sequence
    index: mi.UInt32  # the number of the point, its bits reversed
    dimension: mi.UInt32  # the number of pairs read so far

    def next_1d(self) -> mi.Float:
        """A number in [0, 1)."""
        seed = self._next_seed()  # and as in `next_2d`, whose first coordinate this is
        return _unit(_scramble(dr.brev(_scramble(self.index, seed)), _mix(seed)))

    def next_independent(self) -> mi.Float:
        """A number in [0, 1) that is not stratified, for uses that gain nothing from stratification."""
        return mi.Float(_mix(self._next_seed() ^ self.index) >> 8) * _ULP

    def next_2d(self) -> mi.Point2f:
        """A point in [0, 1)²."""
        seed = self._next_seed()
        x = _scramble(self.index, seed)  # the reversed bits of a shuffled index, which are Sobol's first coordinate
        index = dr.brev(x)
        first = _mix(seed)
        return mi.Point2f(_unit(_scramble(index, first)), _unit(_scramble(_sobol_1(index), _mix(first))))

    def skip_ahead(self) -> Sampler:
        """The same point, 2¹⁵ pairs of dimensions further on, which no path of fewer than 5000 vertices reaches."""
        return Sampler(self.sequence, self.index, self.dimension + (1 << 15))

    def _next_seed(self) -> mi.UInt32:
        """The seed of the next pair of dimensions' scramble."""
        self.dimension += 1
        return _mix(self.sequence ^ (self.dimension * 0x9E3779B9))


def sampler(sequence: mi.UInt32, index: mi.UInt32) -> Sampler:
    """The points ``index`` of the sequences ``sequence``."""
    return Sampler(mi.UInt32(sequence), dr.brev(index), mi.UInt32(0))


def shifts(seeds: Sequence[int], launch: Launch, connections: int) -> mi.UInt32:
    """The shifts that are added to the slots that eye paths are joined to (see Lanes.partner), [K·64·n_C].

    There is one for each image of a launch, depth and connection, uniform below the number of light paths.
    """
    generators = [np.random.default_rng([seed, PAIRING, launch.first_sample]) for seed in seeds]
    table = [each.integers(launch.light_paths, size=SHIFTS * connections) for each in generators]
    return mi.UInt32(np.concatenate(table).tolist())  # a list: Dr.Jit compiles again for each alignment of numpy's


def places(keys: mi.UInt32, sample: mi.UInt32, pixel: mi.UInt32) -> mi.Float:
    """Where in a sample's share of the light paths each pixel finds the one that its eye path is joined to, in [0, 1).

    Light paths close to each other start alike, or are copies of one, so pixels joined to them have noise in common.
    The places of a sample's pixels are stratified, so that light paths are used about equally often. They are random,
    because under any regular rule pixels at certain offsets would be joined to close light paths, which shows as
    streaks or a pattern.
    """
    return sampler(stream(keys, PAIRING, sample), pixel).next_1d()


def learning_seeds(seed: int, images: int) -> list[int]:
    """The seeds of images from which a guide is learned; images that are rendered with it have others."""
    return [int(s) for s in np.random.default_rng([seed, LEARNING]).integers(1 << 32, size=images)]


def along_curve(lane: mi.UInt32, n: mi.UInt32, rng: Sampler) -> mi.Point2f:
    """A stratified point in [0, 1)² for each of ``n`` [1] lanes; lanes of close numbers get points close to each other.

    Lane k gets a uniform point of the k-th piece of Morton's curve, cut into n equal pieces (He and Owen, *Extensible
    grids: uniform sampling on a space filling curve*, 2016). Rays with similar origins are traced faster together.
    The place along the curve has 32 bits, 16 for each coordinate; the bits below them are drawn independently.
    """
    length = mi.UInt32((mi.Float64(lane) + mi.Float64(rng.next_1d())) * (4294967296.0 / mi.Float64(n)))
    return point_on_curve(length, mi.Point2f(rng.next_independent(), rng.next_independent()))


def point_on_curve(place: mi.UInt32, below: mi.Point2f) -> mi.Point2f:
    """The points in [0, 1)² at places on Morton's curve of 16 bits a coordinate; ``below`` is the place in the cell."""
    return dr.minimum((corner_of(place) + below) / (1 << 16), dr.one_minus_epsilon(mi.Float))


def corner_of(cell: mi.UInt32) -> mi.Point2f:
    """The lower corner of the cells with these numbers along Morton's curve, in cells."""
    return mi.Point2f(mi.Float(every_other_bit(cell)), mi.Float(every_other_bit(cell >> 1)))


def every_other_bit(x: mi.UInt32) -> mi.UInt32:
    """The 16 bits at even places, moved together."""
    for shift, bits in ((0, 0x55555555), (1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        x = (x | (x >> shift)) & bits
    return x


def _mix(x: mi.UInt32) -> mi.UInt32:
    """A hash of 32 bits (Wellons, *lowbias32*, 2018)."""
    x = mi.UInt32(x)
    x ^= x >> 16
    x *= 0x21F0AAAD
    x ^= x >> 15
    x *= 0xD35A2D97
    return x ^ (x >> 15)


def _scramble(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen's scramble of a number whose bits are reversed: each bit is flipped by a hash of the bits below it."""
    x = x + seed
    x ^= x * 0x6C50B47C
    x ^= x * 0xB82F1E52
    x ^= x * 0xC7AFE638
    return x ^ (x * 0x8D22F6E6)


def _sobol_1(index: mi.UInt32) -> mi.UInt32:
    """The reversed bits of Sobol's second coordinate: Pascal's triangle modulo 2, times the bits of the index."""
    x = index
    for shift, bits in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = x ^ ((x >> shift) & bits)
    return x


def _unit(reversed_bits: mi.UInt32) -> mi.Float:
    """The number in [0, 1) with these binary digits, given in reverse order; it keeps the 24 that a Float holds."""
    return mi.Float(dr.brev(reversed_bits) >> 8) * _ULP
