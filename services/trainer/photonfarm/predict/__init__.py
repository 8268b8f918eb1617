"""Images of a trained network: of samples of a store, of camera paths, and of any configuration and view.

This package alone stands above renderer and trainer: it may use both in one process, with both extras installed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from photonfarm.predict.opened_run import OpenRun


def open_run(
    run: str | Path, store: str | Path = "store", device: str = "auto", *, fov: float | None = None
) -> OpenRun:
    """Load the network of a run folder, and from a store the scene that it was trained on.

    `fov` is the field of view along the width in degrees of all views that are not asked for with another; by default
    each has its own, or the spec's.

    The renderer uses the card if there is one, else the processor, as PHOTONFARM_DEVICE says. Unless a `device` is
    named, the network uses the same, or the processor where torch cannot use that card.

    Raises StoreError for a folder without a checkpoint, and for a store without the scene; SpecError without the
    renderer, for a scene or a network that cannot be loaded, and for a device that torch cannot use; BackendError where
    Mitsuba does not work, or the scene's files are not on this machine.
    """
    from photonfarm.predict.opened_run import OpenRun
    from photonfarm.trainer.predictors.trained import TrainedRun

    return OpenRun(TrainedRun.load(Path(run)), store, device, fov)


__all__ = ["open_run"]
