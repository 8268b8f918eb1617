"""Records launches: Python traces each kind once, by ``dr.freeze`` with an explicit key; later ones are replayed.

Between launches, paths are drawn anew in proportion to their weights: systematic resampling (Kitagawa 1996), the same
on any machine. N slots stand side by side; a path of the weight w takes N·w/Σw of them on average, and the next path
the slots after it. A single random offset shifts all of them, so that a path gets its part of the slots, rounded up or
down.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVarTuple

import drjit as dr
import mitsuba as mi

State = TypeVarTuple("State")

log = logging.getLogger(__name__)

RECORDINGS = 16
"""The number of recordings kept; the oldest is dropped for a new one."""

ATTEMPTS = 2
"""The number of attempts at a recording."""


class Recorder:
    """Calls a function of a scene, a sensor and other arguments, and records it once for each kind of call.

    ``dr.freeze`` distinguishes calls by the variables among the arguments and by hashes of Python's numbers. It has
    been seen to replay the recording of another number (Dr.Jit 1.5), so each kind has a recording of its own.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Record calls of ``function``."""
        self._function = function
        self._recorded: dict[Hashable, _Recording] = {}

    def __call__(self, kind: Hashable, scene: mi.Scene, sensor: mi.Sensor | None, *arguments: Any) -> Any:
        """The function's result. ``kind`` holds every number for which the kernels are compiled.

        If an attempt to record fails, the function is called directly. One attempt may fail because Mitsuba builds some
        tables when they are first needed. After a second failure, as with lenses, the function is always called
        directly. A recording keeps its scene and sensor, so that no others can get their ids.
        """
        kind = (id(scene), id(sensor), kind)
        if kind not in self._recorded:
            while len(self._recorded) >= RECORDINGS:
                self._recorded.pop(next(iter(self._recorded)))
            self._recorded[kind] = _Recording(_freeze(self._function), scene, sensor)
        recording = self._recorded[kind]
        if recording.failures < ATTEMPTS:
            try:
                return recording.call(scene, sensor, *arguments)
            except RuntimeError as error:
                log.debug("not recorded: %s", error)
                recording.failures += 1
                recording.call = _freeze(self._function)
        return self._function(scene, sensor, *arguments)


def call_recorded(
    recorder: Recorder | None,
    function: Callable[..., Any],
    kind: Hashable,
    scene: mi.Scene,
    sensor: mi.Sensor | None,
    *arguments: Any,
) -> Any:
    """The result of ``function`` by its ``recorder``, or called directly if there is none."""
    return function(scene, sensor, *arguments) if recorder is None else recorder(kind, scene, sensor, *arguments)


@dataclass(slots=True)
class _Recording:
    """A function recorded for one kind of call, and the number of failed attempts."""

    call: Callable[..., Any]
    scene: mi.Scene
    sensor: mi.Sensor | None
    failures: int = 0


def _freeze(function: Callable[..., Any]) -> Callable[..., Any]:
    """The recorded function, in at most two variants: Dr.Jit records again if it took data for a constant."""
    frozen: Callable[..., Any] = dr.freeze(function, warn_after=1 << 30, limit=2)
    return frozen


def loop_once(
    *,
    state: tuple[*State],
    cond: Callable[[*State], mi.Bool],
    body: Callable[[*State], tuple[*State]],
    labels: Sequence[str],
    label: str,
) -> tuple[*State]:
    """Run ``dr.while_loop`` in symbolic mode, without the second tracing by which Dr.Jit looks for invariant state.

    Tracing takes most of the time of a small image, and these loops have hardly any invariant state. Dr.Jit evaluates
    the annotations of dataclasses in ``state``, so the names in them must exist at run time.
    """
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        final: tuple[*State] = dr.while_loop(state, cond, body, labels=labels, label=label, mode="symbolic")
    return final


STEPS = 1 << 24
"""Weights are rounded up to whole multiples of the largest one over this. So their sums are exact in any order, and the
same paths are drawn on any number of threads."""


def resample(weight: mi.Float, offset: mi.Float, paths: mi.UInt32) -> tuple[mi.UInt32, mi.Float]:
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
