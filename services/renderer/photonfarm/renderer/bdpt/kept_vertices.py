"""The kept vertices of light paths: one record of 32 numbers for each path, next to each other in memory.

A connection reads all of a vertex, so one record is a few cache lines where columns would be a line for each number.
The surface is kept as it was found. To find it again would take longer than to read it.

Connections find the vertices in slots, as many as there are paths, in which paths were drawn in proportion to their
weights. So none goes to a path that left the scene. The draw is systematic resampling (Kitagawa 1996), the same on any
machine: the N slots of an image stand side by side; a path of the weight w takes N·w/Σw of them on average, and the
next path the slots after it. A single random offset shifts all of them, so a path gets its part rounded up or down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

Record: TypeAlias = "tuple[mi.Vector4f, ...]"
"""What is read and written at once."""

_QUADS = 8  # vectors of 4 numbers in a record; Dr.Jit reads and writes one at once
_POWER = 5  # the one that begins with the throughput


@dataclass(slots=True)
class KeptVertex:
    """A vertex of a light path as connections see it."""

    si: mi.SurfaceInteraction3f  # what materials read: p, n, sh_frame, wi, uv, dp_du, dp_dv, shape and prim_index
    throughput_over_cos: mi.Spectrum  # over |cos| of the direction of arrival with the geometric normal
    counted_dvcm: mi.Float  # count · dVCM on arrival, with the count of the technique that joins the vertex before
    dvc: mi.Float  # on arrival: see weights.py
    count: mi.Float  # of the technique that joins this vertex
    depth: mi.UInt32  # edges from the light; 0 where there is no vertex

    @property
    def is_there(self) -> mi.Bool:
        """Whether there is a vertex: none is where no path of the image reached one that a connection could reach."""
        return self.depth > 0

    def record(self) -> Record:
        """Everything in it, as it lies in memory."""
        si = self.si
        quads = (
            (*si.p, _bits_to_float(self.depth)),
            (*si.n, _bits_to_float(dr.reinterpret_array(mi.UInt32, si.shape))),
            (*si.sh_frame.n, _bits_to_float(si.prim_index)),
            (*si.sh_frame.s, self.counted_dvcm),
            (*si.wi, self.dvc),
            (*self.throughput_over_cos, si.uv.x),
            (*si.dp_du, si.uv.y),
            (*si.dp_dv, self.count),
        )
        return tuple(mi.Vector4f(*quad) for quad in quads)


@dataclass(slots=True)
class KeptVertices:
    """Records of the kept vertices of the light paths of K images, N each, and the slots in which they are drawn."""

    numbers: mi.Float  # [K·N · 32]
    slots: mi.UInt32  # [K·N]: the path in each slot

    @classmethod
    def of(cls, record: Record, weight: mi.Float, offset: mi.Float, paths: mi.UInt32) -> KeptVertices:
        """The kept vertices of all lanes' paths, whose records hold throughputs over their own weights.

        ``weight`` [K·N] are sums over all vertices of a path that could have been kept, ``offset`` [K] random numbers,
        and ``paths`` [1] is N.
        """
        n = dr.width(weight)
        slots, factor = resample(weight, offset, paths)
        numbers = dr.empty(mi.Float, n * 4 * _QUADS)
        power = record[_POWER]
        scaled = mi.Vector4f(*(power[k] * factor for k in range(3)), power.w)
        for k, quad in enumerate((*record[:_POWER], scaled, *record[_POWER + 1 :])):  # no two lanes write in one place
            dr.scatter(numbers, quad, dr.arange(mi.UInt32, n) * _QUADS + k, mode=dr.ReduceMode.NoConflicts)
        return cls(numbers, slots)

    def draw(self, slot: mi.UInt32, active: mi.Bool) -> KeptVertex:
        """The kept vertices of the paths in slots; all or none of an image's slots have one."""
        return self.read(dr.gather(mi.UInt32, self.slots, slot, active), active)

    def read(self, path: mi.UInt32, active: mi.Bool) -> KeptVertex:
        """The kept vertex of light path ``path``, if there is one."""
        p, n, frame_n, frame_s, wi, throughput, dp_du, dp_dv = (
            dr.gather(mi.Vector4f, self.numbers, path * _QUADS + k, active) for k in range(_QUADS)
        )
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(path))
        si.t = mi.Float(0)  # finite: a surface was hit
        si.p, si.n, si.wi = p.xyz, mi.Normal3f(n.xyz), wi.xyz
        s, normal = frame_s.xyz, frame_n.xyz
        si.sh_frame = mi.Frame3f(s, dr.cross(normal, s), normal)
        si.dp_du, si.dp_dv = dp_du.xyz, dp_dv.xyz
        si.uv = mi.Point2f(throughput.w, dp_du.w)
        si.prim_index = _float_to_bits(frame_n.w)
        si.shape = dr.reinterpret_array(mi.ShapePtr, _float_to_bits(n.w))
        return KeptVertex(si, mi.Spectrum(throughput.xyz), frame_s.w, wi.w, dp_dv.w, _float_to_bits(p.w))


def empty_record() -> Record:
    """A record of zeros."""
    return tuple(mi.Vector4f(0) for _ in range(_QUADS))


def _bits_to_float(bits: mi.UInt32) -> mi.Float:
    """The Float of these bits."""
    return dr.reinterpret_array(mi.Float, bits)


def _float_to_bits(number: mi.Float) -> mi.UInt32:
    """The bits of a Float."""
    return dr.reinterpret_array(mi.UInt32, number)


STEPS = 1 << 24
"""Weights are rounded up to whole multiples of the largest one over this. So their sums are exact in any order, and the
same paths are drawn on any number of threads."""


def resample(weight: mi.Float, offset: mi.Float, paths: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
    """(the path that each slot gets, a factor for each path), [K·N] both.

    ``weight`` [K·N] ≥ 0 has the N = ``paths`` [1] paths of each of K images, ``offset`` [K] random numbers in [0, 1).
    An image's slots get paths of its own; where all its weights are 0, its first. For any x, the sum of
    factor·x/weight over an image's slots has as its expectation the sum of x over its paths of a weight above 0.
    """
    n, images = dr.width(weight), dr.width(offset)
    lane = dr.arange(mi.UInt32, n)
    image = lane // paths if images > 1 else dr.zeros(mi.UInt32, n)
    first = image * paths
    weight = dr.select(dr.isfinite(weight), weight, 0)
    largest = dr.max(weight) if images == 1 else dr.block_reduce(dr.ReduceOp.Max, weight, n // images)
    largest = mi.Float64(dr.gather(mi.Float, largest, image))
    steps = dr.select(weight > 0, dr.ceil(mi.Float64(weight) * (STEPS / largest)), 0)

    running = dr.cumsum(steps)
    before = dr.gather(mi.Float64, running, dr.maximum(first, 1) - 1, first > 0)
    total = dr.gather(mi.Float64, running, first + (paths - 1)) - before
    count = mi.Float64(paths)
    slots_per_step = count / dr.maximum(total, 1)
    u = mi.Float64(dr.gather(mi.Float, offset, image))

    def slot(sum_before: mi.Float64) -> mi.UInt32:
        return mi.UInt32(dr.clip(dr.ceil(sum_before * slots_per_step - u), 0, count))

    begin, end = slot(running - steps - before), slot(running - before)
    taken = mi.UInt32(first)
    # Only the first slot of each path is written. The others are later ones and get the largest path before them.
    dr.scatter(taken, lane, first + begin, end > begin, mode=dr.ReduceMode.NoConflicts)
    factor = dr.select(steps > 0, mi.Float64(weight) / steps * (total / count), 0)
    return dr.prefix_reduce(dr.ReduceOp.Max, taken, exclusive=False), mi.Float(factor)
