"""Launches traced by Python once and replayed afterwards: `dr.freeze`, with its key made explicit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import drjit as dr

log = logging.getLogger(__name__)

RECORDINGS = 16
"""The number of recordings kept: the oldest makes room for a new one."""

ATTEMPTS = 2


class Recorder:
    """Calls a function of a scene, a sensor and other arguments, recorded once for each kind of call.

    `dr.freeze` distinguishes calls by the variables of their arguments and by the hashes of Python's numbers among
    them, and was observed to replay the recording of another number (Dr.Jit 1.5). So each kind has a recording of its
    own.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Record calls of `function`."""
        self._function = function
        self._recorded: dict[Hashable, _Recording] = {}

    def __call__(self, kind: Hashable, scene: Any, sensor: Any, *arguments: Any) -> Any:
        """Call the function; `kind` holds every number that the kernels are compiled for.

        A call that cannot be recorded runs unrecorded: for good if a second attempt fails too (lenses); Mitsuba makes
        some tables at their first use, which fails one attempt. The scene and the sensor of a recording are kept, so
        that no others are taken for them.
        """
        kind = (id(scene), id(sensor), kind)
        if kind not in self._recorded:
            while len(self._recorded) >= RECORDINGS:
                self._recorded.pop(next(iter(self._recorded)))
            self._recorded[kind] = _Recording(_frozen(self._function), scene, sensor)
        recording = self._recorded[kind]
        if recording.failures < ATTEMPTS:
            try:
                return recording.call(scene, sensor, *arguments)
            except RuntimeError as error:
                log.debug("not recorded: %s", error)
                recording.failures += 1
                recording.call = _frozen(self._function)
        return self._function(scene, sensor, *arguments)


@dataclass(slots=True)
class _Recording:
    call: Callable[..., Any]
    scene: Any
    sensor: Any
    failures: int = 0


def _frozen(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, recorded. Two variants at most: Dr.Jit records once more if it took data for a constant."""
    frozen: Callable[..., Any] = dr.freeze(function, warn_after=1 << 30, limit=2)
    return frozen


def traced_once(**arguments: Any) -> tuple[Any, ...]:
    """``dr.while_loop`` in symbolic mode, without the second tracing by which Dr.Jit looks for loop-invariant state.

    Tracing is most of the time of a small image, and these loops have next to no invariant state to find.
    """
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        return dr.while_loop(mode="symbolic", **arguments)
