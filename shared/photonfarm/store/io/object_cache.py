"""Copies of a bucket's objects on this machine: the most recently used ones, up to a limit.

A copy's name contains the version of its object, so a stale one is never used. Copies appear whole, by rename, and any
number of processes share them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Self

from photonfarm.core.errors import StoreError
from photonfarm.store.io.local import LocalStorage, sync
from photonfarm.store.io.storage import discard

FOLDER_VARIABLE = "PHOTONFARM_CACHE"
"""The variable with the folder of copies and unfinished files; by default ~/.cache/photonfarm."""

LIMIT_VARIABLE = "PHOTONFARM_CACHE_GB"
LIMIT_GB = 20.0
"""The default limit for the copies of one store."""

KEPT_S = 60.0
"""A copy used so recently is kept whatever the limit: its reader may be about to open it."""

FILES = "files"


class ObjectCache:
    """The copies of one store's objects, and its unfinished files."""

    def __init__(self, folder: Path, limit_bytes: float) -> None:
        """Name the folder; it is made when it is needed."""
        self._files = folder / FILES
        self._parts = LocalStorage(folder)
        self._limit_bytes = limit_bytes
        self._added_bytes = limit_bytes  # by this process since it last looked; at first so many that it looks

    @classmethod
    def of(cls, url: str) -> Self:
        """The cache of a store, with folder and limit from the variables; raises StoreError for an invalid one."""
        named = os.environ.get(FOLDER_VARIABLE)
        root = Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "photonfarm"
        given = os.environ.get(LIMIT_VARIABLE) or LIMIT_GB
        try:
            limit_gb = float(given)
        except ValueError as error:
            raise StoreError(f"{LIMIT_VARIABLE} = {given!r}: a number of gigabytes is required") from error
        return cls(root / "objects" / hashlib.sha256(url.encode()).hexdigest()[:16], limit_gb * 1e9)

    def path(self, name: str, version: str | None) -> Path:
        """The path of the copy of an object's version; without a version, a path where there is never a file."""
        return self._files / (name if version is None else f"{name}@{version}")

    def has(self, copy: Path, size: int) -> bool:
        """Whether there is a copy of so many bytes; if so, it now counts as just used."""
        try:
            os.utime(copy)
            return copy.stat().st_size == size
        except FileNotFoundError:
            return False

    @contextlib.contextmanager
    def filling(self, copy: Path) -> Iterator[BinaryIO]:
        """A file to write a copy to; after the block the copy is there, whole, unless the block raised."""
        part = self.part()
        try:
            with part.open("xb") as file:
                yield file
            copy.parent.mkdir(parents=True, exist_ok=True)
            self._make_room(part.stat().st_size)
            sync(part, data_only=True)  # a copy that a power cut emptied would be taken for the object
            part.replace(copy)
        finally:
            discard(part)

    def part(self) -> Path:
        """A new path to write to, on the same file system."""
        return self._parts.part()

    def sweep(self, *, stray_age_s: float) -> int:
        """Remove parts that dead processes left; returns how many."""
        return self._parts.sweep(stray_age_s=stray_age_s)

    def _make_room(self, size: int) -> None:
        """Remove the least recently used copies if there are too many; looks once per sixteenth of the limit."""
        self._added_bytes += size
        if self._added_bytes < self._limit_bytes / 16:
            return
        self._added_bytes = 0.0
        copies = []
        for path in self._files.rglob("*"):
            with contextlib.suppress(FileNotFoundError):  # another process was faster, here and below
                if path.is_file():
                    about = path.stat()
                    copies.append((about.st_mtime, about.st_size, path))
        total = size + sum(about[1] for about in copies)
        for used, bytes_, path in sorted(copies):
            if total <= self._limit_bytes * 15 / 16 or used > time.time() - KEPT_S:
                return
            with contextlib.suppress(FileNotFoundError):
                path.unlink()
            total -= bytes_
