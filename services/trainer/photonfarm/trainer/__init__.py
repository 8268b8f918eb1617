"""The trainer service: neural light transport learned from a store that grows.

In Python::

    from photonfarm.trainer import train
    run = train("store", "room", "run", max_steps=1000)
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from photonfarm.trainer.predict.trained import TrainedRun

__all__ = ["train"]


def train(store: str | Path, scene: str, run: str | Path, *, preset: str = "small", **settings: Any) -> TrainedRun:
    """Train on a scene's samples, or continue a run; returns the run with its last weights.

    `store` is a folder or the URL of a bucket, and `scene` a scene's name, its id, or the beginning of its id. The
    settings are a preset's with changes by key, such as `max_steps`, `architecture` or `width`; `photonfarm train
    --help` lists them. The folder `run` is that of `photonfarm train --run`: either goes on with what the other began.

    Raises SpecError for settings that cannot be, StoreError for a store that cannot be read and a folder that cannot be
    written, and DivergedError if training diverges.
    """
    from photonfarm.shared.store import Store  # torch is slow to load, and settings are read without it
    from photonfarm.shared.store.read.find import scene_named
    from photonfarm.trainer.data.store_source import StoreSource
    from photonfarm.trainer.predict.trained import TrainedRun
    from photonfarm.trainer.runs.settings import settings_of
    from photonfarm.trainer.training import loop

    source = StoreSource(store, scene_named(Store(store), scene))
    loop.train(source, settings_of(preset, settings), Path(run))
    return TrainedRun.load(Path(run))
