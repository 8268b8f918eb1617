"""Random numbers: one independent PCG32 stream for each lane, keyed by (seed, pass, kind of path).

Seeds enter the kernels as data, so another seed never compiles anything. The sensor's own sampler only says how many
samples a pixel gets by default: stratified and low-discrepancy samplers would be used up differently by two kinds of
path.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

LIGHT, EYE, PAIRING, PHOTONS = range(4)


def stream_seed(seed: int, part: int, kind: int) -> Any:
    """Seed of one kind of path in one pass, as device data (UInt32, 1), by the Tiny Encryption Algorithm."""
    key = mi.sample_tea_32(int(seed) & 0xFFFFFFFF, part * 4 + kind, 8)
    return dr.opaque(mi.UInt32, key[0])


def generator(seed: Any, n: int) -> Any:
    """N independent generators (mi.PCG32)."""
    state, sequence = mi.sample_tea_32(seed, dr.arange(mi.UInt32, n))
    return mi.PCG32(n, mi.UInt64(state), mi.UInt64(sequence))
