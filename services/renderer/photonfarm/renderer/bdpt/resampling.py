"""Draws paths anew in proportion to their weights: systematic resampling (Kitagawa 1996), the same on any machine.

N slots stand side by side; a path of the weight w takes N·w/Σw of them on average, and the next path the slots after
it. A single random offset shifts all of them, so that a path gets its part of the slots, rounded up or down.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

STEPS = 1 << 24
"""Weights are rounded up to whole multiples of the largest one over this. So their sums are exact in any order, and the
same paths are drawn on any number of threads."""


def resampled(weight: mi.Float, offset: mi.Float, paths: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
    """(the path that each slot gets, a factor for each path), [K·N] both.

    ``weight`` [K·N] ≥ 0 are those of ``paths`` [1] = N paths for each of K images, ``offset`` [K] are random numbers in
    [0, 1). An image's slots get paths of its own; where all its weights are 0, its first. For any x, the sum of
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
    dr.scatter(taken, lane, first + begin, end > begin, mode=dr.ReduceMode.NoConflicts)
    factor = dr.select(steps > 0, mi.Float64(weight) / steps * (total / count), 0)
    return dr.prefix_reduce(dr.ReduceOp.Max, taken, exclusive=False), mi.Float(factor)
