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
from collections.abc import Iterable, Iterator
from functools import cache
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


def temporary(folder: Path) -> Path:
    """A new name in a `tmp` folder that says whose it is: host, process space, process, number, time."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{_owner()}-{os.getpid()}-{next(_counter)}-{time.time_ns():x}.partial"


@cache
def _owner() -> str:
    """Where process numbers mean what they mean here: containers may share a host's name, but not its processes."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()[:8]
        space = f"{boot}{Path('/proc/self/ns/pid').stat().st_ino:x}"
    except OSError:  # not Linux, hence no containers: the host's name must do
        space = "0"
    return f"{socket.gethostname()}-{space}"


def place(data: bytes | memoryview, final: Path, tmp: Path, *, replace: bool = False) -> bool:
    """Write `data` durably under a new name; False if the name was taken, which keeps what is there.

    With `replace` it is written in any case, and takes the place of what is there at once.
    """
    partial = temporary(tmp)
    try:
        with partial.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fdatasync(stream.fileno())
        if replace:
            partial.replace(final)
            return True
        try:
            os.link(partial, final)
        except FileExistsError:
            return False
        return True
    finally:
        partial.unlink(missing_ok=True)


def place_json(document: dict[str, Any], final: Path, tmp: Path) -> bool:
    """Write a JSON document durably under a new name; False if the name was taken, which keeps what is there."""
    _make_folder(final.parent)
    data = (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode()
    placed = place(data, final, tmp)
    sync_folder(final.parent)
    return placed


def place_folder(built: Path, final: Path) -> bool:
    """Rename a folder that was built aside to its final name; False if another is there already."""
    sync_tree(built)
    _make_folder(final.parent)
    try:
        built.rename(final)  # fails on a folder that is there, since none of ours is ever empty
    except OSError:
        if not final.is_dir():
            raise
        return False
    sync_folder(final.parent)
    return True


def _make_folder(folder: Path) -> None:
    """Make a folder, durably, if it is not there."""
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        sync_folder(folder.parent)


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


def describe(files: Iterable[Path], relative_to: Path) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of files as they lie on disk, by path below a folder."""
    described = {}
    for path in sorted(files):
        data = path.read_bytes()
        name = str(path.relative_to(relative_to))
        described[name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return described


class DurableStore(LocalStore):
    """Zarr's local store for chunks that are written once, by whoever comes first; `kept` names those that were there.

    Nothing is replaced through it, unless `replace` is set. The caller syncs the folders before announcing the files.
    """

    def __init__(self, root: Path | str, *, tmp: Path, replace: bool = False, read_only: bool = False) -> None:
        super().__init__(root, read_only=read_only)
        self._tmp = tmp
        self._replace = replace
        self.kept: set[str] = set()

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write one chunk, durably."""
        self._check_writable()
        data = memoryview(value.as_buffer_like())
        if not place(data, self.root / key, self._tmp, replace=self._replace):
            self.kept.add(key)

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
    owner, *numbers = name.rsplit("-", 3)  # from the right: a host's name may hold any number of -
    if owner != _owner():
        return False  # of another machine or container
    try:
        os.kill(int(numbers[0]), 0)
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
