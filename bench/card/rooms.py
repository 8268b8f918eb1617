"""The rooms that are measured, their views, and the clock of the device that renders."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.harness.scenes import in_passes, ready_spec, square
from photonfarm.scene.modification import Modification, sample_modification
from photonfarm.scene.view import View, sample_view

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

ROOMS = ("room", "veach-ajar", "living-room-2")
"""The built-in room, and two that are there where PHOTONFARM_SCENES names their folder."""


def load_room(name: str, size: int, half_spp: int) -> LoadedScene:
    """A room with square images, loaded on this machine's device. Raises SpecError where its scene file is missing."""
    from photonfarm.renderer.scene import backend

    spec = in_passes(square(ready_spec(name), size), half_spp)
    backend.load(threads=1)
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

    return LoadedScene.load(spec)


def draw_view(scene: LoadedScene, number: int, of_it: int = 0) -> tuple[Modification, bytes, View]:
    """The configuration of this number, its key, and one of its views."""
    modification = sample_modification(scene.spec, 0, number)
    key = modification.key(scene.spec.radiance_id)
    return modification, key, sample_view(scene.spec, key, 0, of_it, modification)


def make_once(store: Path, fill: Callable[[Path], object]) -> None:
    """Fill a store, unless an earlier part has; one that is not filled to its end leaves nothing."""
    if not store.is_dir():
        with tempfile.TemporaryDirectory(dir=store.parent) as folder:
            fill(made := Path(folder) / "store")
            made.rename(store)


def on_card() -> bool:
    """Whether a card renders in this process."""
    from photonfarm.renderer.scene import backend

    return backend.device().card is not None


def seconds(work: Callable[[], Any]) -> float:
    """The seconds of some work whose result is in numpy's memory; of the processor, where that renders."""
    from photonfarm.renderer.scene import backend

    began = backend.work_s()
    work()
    return backend.work_s() - began


def first_and_median(work: Callable[[int], Any], repetitions: int) -> tuple[float, float]:
    """Seconds of the first call, which compiles, and of later ones; each call is given a number of its own.

    The second call, which may record a launch once more, does not count.
    """
    first, _, *others = (seconds(partial(work, number)) for number in range(repetitions + 2))
    return first, statistics.median(others)
