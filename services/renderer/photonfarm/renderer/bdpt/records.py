"""Records in memory: vectors of four numbers, next to each other.

What is needed at once lies together, so it takes a few cache lines, where columns would take one for each number; and
Dr.Jit reads, writes and adds four neighbours at once.
"""

from __future__ import annotations

from typing import TypeAlias

import drjit as dr
import mitsuba as mi

Record: TypeAlias = "tuple[mi.Vector4f, ...]"
"""What is read and written at once."""


def write(memory: mi.Float, place: mi.UInt32, record: Record) -> None:
    """Write a record at ``place``, where no other lane writes."""
    for k, quad in enumerate(record):
        dr.scatter(memory, quad, place * len(record) + k, mode=dr.ReduceMode.NoConflicts)


def read(memory: mi.Float, place: mi.UInt32, quads: int, active: mi.Bool) -> Record:
    """The record of so many vectors at ``place``."""
    return tuple(dr.gather(mi.Vector4f, memory, place * quads + k, active) for k in range(quads))


def as_float(bits: mi.UInt32) -> mi.Float:
    """The Float of these bits."""
    return dr.reinterpret_array(mi.Float, bits)


def as_uint(number: mi.Float) -> mi.UInt32:
    """The bits of a Float."""
    return dr.reinterpret_array(mi.UInt32, number)
