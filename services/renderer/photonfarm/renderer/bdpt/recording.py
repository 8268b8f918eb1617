"""Records launches: Python traces each kind once, by ``dr.freeze`` with an explicit key; later ones are replayed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
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


class Recorders(dict[Callable[..., Any], Recorder]):
    """The recorders of functions, each made when it is first needed."""

    def __missing__(self, function: Callable[..., Any]) -> Recorder:
        """Make the recorder of a function."""
        self[function] = recorder = Recorder(function)
        return recorder


def call_recorded(
    recorders: Recorders | None,
    function: Callable[..., Any],
    kind: Hashable,
    scene: mi.Scene,
    sensor: mi.Sensor | None,
    *arguments: Any,
) -> Any:
    """The result of ``function`` by its recorder, or called directly if there are none."""
    call = function if recorders is None else partial(recorders[function], kind)
    return call(scene, sensor, *arguments)


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
