"""Files that other processes find whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from photonfarm.core.errors import store_errors


@contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """Where to write what `file` will be: a path beside it, which is renamed to `file` at the end of the block.

    Makes the folder. If the block raises, `file` stays as it was. Raises OSError if the disk refuses. The rename is
    not synced, so a machine that fails may lose it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.stem}.{os.getpid()}.partial{file.suffix}")
    try:
        yield part
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def make_folder(folder: Path, doing: str) -> None:
    """Make a folder, and see that it can be written to, before long work whose result goes there.

    Raises StoreError, which names what one was `doing`, if the disk refuses.
    """
    with store_errors(doing, folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


def write_whole(file: Path, text: str) -> None:
    """Write a text file that appears whole. Raises OSError if it cannot be written."""
    with whole_file(file) as part:
        part.write_text(text, encoding="utf-8")
