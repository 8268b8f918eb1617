"""Launches are traced by Python once and replayed afterwards, by ``dr.freeze`` with its key made explicit."""

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
"""The number of recordings kept: the oldest makes room for a new one."""

ATTEMPTS = 2


class Recorder:
    """Calls a function of a scene, a sensor and other arguments, recorded once for each kind of call.

    ``dr.freeze`` tells calls apart by its arguments' variables and by the hashes of Python's numbers among them, and
    has been seen to replay the recording of another number (Dr.Jit 1.5). So each kind has a recording of its own.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Record calls of ``function``."""
        self._function = function
        self._recorded: dict[Hashable, _Recording] = {}

    def __call__(self, kind: Hashable, scene: mi.Scene, sensor: mi.Sensor | None, *arguments: Any) -> Any:
        """The function's result. ``kind`` holds every number that the kernels are made for.

        Where recording fails, the function is called as it is: Mitsuba makes some tables when they are first asked for,
        which fails one attempt. It is called so for good once a second attempt has failed (lenses). The scene and the
        sensor of a recording are kept, so that no others are taken for them.
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
    """A function recorded for one kind of call, and how many attempts have failed."""

    call: Callable[..., Any]
    scene: mi.Scene
    sensor: mi.Sensor | None
    failures: int = 0


def _frozen(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, recorded; in two variants at most, as Dr.Jit records again where it took data for a constant."""
    frozen: Callable[..., Any] = dr.freeze(function, warn_after=1 << 30, limit=2)
    return frozen


def traced_once(
    *,
    state: tuple[*State],
    cond: Callable[[*State], mi.Bool],
    body: Callable[[*State], tuple[*State]],
    labels: Sequence[str],
    label: str,
) -> tuple[*State]:
    """``dr.while_loop`` in symbolic mode, without the second tracing by which Dr.Jit looks for loop-invariant state.

    Tracing is most of the time of a small image, and these loops have next to no invariant state to find. Dr.Jit
    evaluates the annotations of dataclasses in ``state``: what they name must be there at run time.
    """
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        final: tuple[*State] = dr.while_loop(state, cond, body, labels=labels, label=label, mode="symbolic")
    return final
