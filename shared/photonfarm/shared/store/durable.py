"""How bytes reach the disk, and stay there.

A file is written under a temporary name in the scene's `tmp` folder, synced, and linked to its final name; a final name
is therefore always a whole file, and the first one stays. Folders are synced before anything announces their files.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import json
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zarr.storage import LocalStore

from photonfarm.shared.errors import StoreError

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype

STRAY_AGE_S = 60.0
"""Temporary files of a dead process of this machine are swept at this age…"""

FOREIGN_AGE_S = 86400.0
"""…and those of other machines, whose processes cannot be asked after, at this one."""

_counter = itertools.count()


@contextlib.contextmanager
def store_errors(doing: str, path: Path) -> Iterator[None]:
    """Turn what the operating system refuses into a StoreError that says what failed, where and why."""
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise StoreError(f"{path}: cannot {doing}: {reason} ({error.filename or path})") from error


@dataclass(frozen=True, slots=True)
class Written:
    """One file as it lies under its final name."""

    size: int  # bytes
    sha256: str
    placed: bool  # False: another writer's complete file was there already


def temporary(folder: Path) -> Path:
    """A new name in a `tmp` folder that says whose it is: host, process, number."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{socket.gethostname()}-{os.getpid()}-{next(_counter)}-{time.time_ns():x}.partial"


def place(data: bytes | memoryview, final: Path, tmp: Path) -> Written:
    """Write `data` durably under a new name, or keep the file that has that name."""
    partial = temporary(tmp)
    try:
        with partial.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fdatasync(stream.fileno())
        try:
            os.link(partial, final)
            return Written(len(data), hashlib.sha256(data).hexdigest(), placed=True)
        except FileExistsError:
            kept = final.read_bytes()
            return Written(len(kept), hashlib.sha256(kept).hexdigest(), placed=False)
    finally:
        partial.unlink(missing_ok=True)


def place_json(document: dict[str, Any], final: Path, tmp: Path) -> bool:
    """Write a JSON document durably under a new name; False if the name was taken, which keeps what is there."""
    final.parent.mkdir(parents=True, exist_ok=True)
    data = (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode()
    placed = place(data, final, tmp).placed
    sync_folder(final.parent)
    return placed


def place_folder(built: Path, final: Path) -> bool:
    """Rename a folder that was built aside to its final name; False if another is there already."""
    sync_tree(built)
    final.parent.mkdir(parents=True, exist_ok=True)
    try:
        built.rename(final)  # fails on a folder that is there, since none of ours is ever empty
    except OSError:
        if not final.is_dir():
            raise
        return False
    sync_folder(final.parent)
    return True


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Make a folder durable with everything below it."""
    for path, _, files in os.walk(folder):
        for name in files:
            descriptor = os.open(Path(path, name), os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(path))


def describe_tree(folder: Path, relative_to: Path) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of every file below a folder, by its path below another."""
    return {
        str(path.relative_to(relative_to)): {
            "size": path.stat().st_size,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class DurableStore(LocalStore):
    """Zarr's local store for chunks that are written once, by whoever comes first; `written` tells what lies there now.

    Nothing is replaced through it. The caller syncs `folders` before announcing the files.
    """

    def __init__(self, root: Path | str, *, tmp: Path, read_only: bool = False) -> None:
        super().__init__(root, read_only=read_only)
        self._tmp = tmp
        self.written: dict[str, Written] = {}

    @property
    def folders(self) -> set[Path]:
        """The folders that hold what was written."""
        return {(self.root / key).parent for key in self.written}

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write one chunk, durably; a name that exists keeps its file."""
        self._check_writable()
        self.written[key] = place(memoryview(value.as_buffer_like()), self.root / key, self._tmp)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Metadata only: zarr reads a shard before it writes the whole of it, and would stop at a damaged one."""
        return await super().get(key, prototype, byte_range) if key.endswith("zarr.json") else None

    async def set(self, key: str, value: Buffer) -> None:
        """The same, for zarr's event loop."""
        await asyncio.to_thread(self.set_sync, key, value)


def sweep(tmp: Path, *, now_s: float, stray_age_s: float = STRAY_AGE_S) -> int:
    """Remove what dead writers left in a `tmp` folder; how many things that were."""
    swept = 0
    if not tmp.is_dir():
        return 0
    for path in tmp.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another sweeper was faster
            age_s = now_s - path.stat().st_mtime
            if age_s > FOREIGN_AGE_S or (age_s > stray_age_s and _is_of_the_dead(path.name)):
                _remove(path)
                swept += 1
    return swept


def _is_of_the_dead(name: str) -> bool:
    host, separator, rest = name.partition(f"{socket.gethostname()}-")
    if host or not separator:
        return False  # of another machine
    process = rest.split("-")[0]
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, ValueError):
        return False
    return False


def _remove(path: Path) -> None:
    import shutil

    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
