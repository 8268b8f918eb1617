"""Launches traced by Python once and replayed afterwards: `dr.freeze`, with its key made explicit."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import drjit as dr

RECORDINGS = 16
"""Kinds of launch kept ready: the oldest makes room for a new one."""


class Recorder:
    """Calls a function of a scene, a sensor and other arguments, recorded once for each kind of call.

    `dr.freeze` tells calls apart by its arguments' variables and by the hashes of Python's numbers among them, and has
    been seen to replay the recording of another number (Dr.Jit 1.5). So each kind has a recording of its own.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Record calls of `function`."""
        self._function = function
        self._recorded: dict[Hashable, tuple[Any, Any, Any]] = {}

    def __call__(self, kind: Hashable, scene: Any, sensor: Any, *arguments: Any) -> Any:
        """The function's result. `kind` holds every number that the kernels are made for.

        The scene and the sensor of a recording are kept, so that no others are taken for them.
        """
        kind = (id(scene), id(sensor), kind)
        if kind not in self._recorded:
            while len(self._recorded) >= RECORDINGS:
                self._recorded.pop(next(iter(self._recorded)))
            # Two variants at most: Dr.Jit records once more where it took data for a constant
            self._recorded[kind] = dr.freeze(self._function, warn_after=1 << 30, limit=2), scene, sensor
        return self._recorded[kind][0](scene, sensor, *arguments)
