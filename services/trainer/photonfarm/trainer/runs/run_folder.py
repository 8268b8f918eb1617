"""The folder of a training run: the names of its files, and the lock that one trainer at a time holds."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from photonfarm.shared.core.errors import StoreError, store_errors

LOCK = "lock"
CHECKPOINT = "checkpoint.safetensors"
INITIAL = "initial.safetensors"
METRICS = "metrics.jsonl"
SETTINGS = "settings.json"


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
