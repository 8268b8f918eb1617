"""The trainer service: neural light transport learned from a store that grows.

In Python::

    from photonfarm.trainer import train
    run = train("store", "room", "run", max_steps=1000)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from photonfarm.trainer.predictors.trained import TrainedRun

__all__ = ["train"]


def train(
    store: str | Path,
    scene: str,
    run: str | Path,
    *,
    preset: str | None = None,
    redis_url: str | None = None,
    log: Callable[[str], object] = print,
    **settings: Any,
) -> TrainedRun:
    """Train on a scene's samples, or continue a run, as `photonfarm train` does; returns the run with its last weights.

    `store` is a folder or the URL of a bucket, and `scene` a scene's name, its id, or the beginning of its id. The
    settings are those of the run, or of a new one those of a preset, by default `card` on a card and `small` elsewhere,
    with changes by key, such as `max_steps`, `architecture` or `width`; `photonfarm train --help` lists them. The
    folder `run` is that of `photonfarm train --run`: either goes on with what the other began, and a run that has ended
    by its steps stays as it is. While it trains, `photonfarm train --check` finds the run alive, and TensorBoard, if it
    is installed, its curves.

    Training waits for samples that workers are still to render, also for the first ones; `log` is told of that, and
    `max_seconds` limits it. With `redis_url`, the queue's Redis, workers learn how many samples are used; without it,
    those of `photonfarm work --ahead` wait for a trainer once they are so many samples ahead. An interrupt (Ctrl-C, or
    a notebook's stop button) ends training with a checkpoint, and the same call goes on.

    Raises SpecError for settings that cannot be, StoreError for a store that cannot be read and a folder that cannot be
    written, IncompleteError if `max_seconds` were over before anything was rendered, and DivergedError if training
    diverges.
    """
    from photonfarm.store import Store  # torch is slow to load, and settings are read without it
    from photonfarm.store.read.find import scene_named
    from photonfarm.trainer import service
    from photonfarm.trainer.predictors.trained import TrainedRun

    scene_id = scene_named(Store(store), scene)
    service.run(None, store, Path(run), preset, settings, redis_url, scene_id=scene_id, log=log)
    return TrainedRun.load(Path(run))
