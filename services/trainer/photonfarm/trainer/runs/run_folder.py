"""The folder of a training run: the names of its files, and the lock that one trainer at a time holds."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from photonfarm.core.errors import StoreError, store_errors
from photonfarm.farm.training import CHECKPOINT, INITIAL, METRICS, SETTINGS
from photonfarm.scene.spec_loading import SCENES_VARIABLE

__all__ = ["CHECKPOINT", "INITIAL", "METRICS", "SETTINGS", "held", "note_scene_folder", "with_scenes"]

LOCK = "lock"
GOOD = "good.safetensors"  # a checkpoint of the last good validation, which a run that diverges goes back to
SCENE_FOLDER = "scene-folder.txt"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Make the folder and lock it; raises StoreError if another trainer has it or it cannot be written.

    The system releases the lock when its process ends, however it ends.
    """
    with store_errors("keep a training run here", folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("ab")
    with file:
        with store_errors("lock the training run", folder):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(f"{folder}: another trainer is at work on this run; use another run folder") from error
        yield


def note_scene_folder(folder: Path, scenes: Path | None) -> None:
    """Note where the run's scene file lies on this machine, for `with_scenes`; None leaves what was noted."""
    if scenes is not None:
        with store_errors("note where the scene lies", folder):
            (folder / SCENE_FOLDER).write_text(f"{scenes}\n")


def with_scenes(folder: Path) -> dict[str, str]:
    """The environment in which the renderer's verbs find a run's scene: where a variable says, else where noted."""
    try:
        noted = (folder / SCENE_FOLDER).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return dict(os.environ)
    folders = filter(None, (os.environ.get(SCENES_VARIABLE), noted))
    return {**os.environ, SCENES_VARIABLE: os.pathsep.join(folders)}
