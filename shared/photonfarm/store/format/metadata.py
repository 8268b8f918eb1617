"""Zarr groups: written whole, and read with the checksums of their metadata.

The attribute `checksums` of a group has the CRC-32C of each zarr.json in it; that of the group's own, which holds them,
is of its bytes with zeros for the digits of that one.
"""

from __future__ import annotations

import contextlib
import errno
import json
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zarr
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore, WrapperStore

from photonfarm.store.format.declarations import check_version
from photonfarm.store.format.shards import crc_of

if TYPE_CHECKING:
    from photonfarm.store.io.storage import Storage

CHECKSUMS = "checksums"
ROOT = "zarr.json"
_ZEROS = "0" * 8


@contextlib.contextmanager
def new_group(folder: Path, attributes: dict[str, Any]) -> Iterator[zarr.Group]:
    """A new group to fill, in a folder that is not adopted yet; at the end it gets the checksums of its metadata.

    After the block nothing more is written, however it ends.
    """
    store = _Part(LocalStore(folder))
    try:
        yield zarr.open_group(store, mode="w-", zarr_format=3, attributes=attributes)
    finally:
        store.end()
    seal(folder)


def seal(folder: Path) -> None:
    """Write the checksums of the metadata into a group that is otherwise complete."""
    own = folder / ROOT
    document = json.loads(own.read_bytes())
    below = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob(ROOT)) if path != own}
    checksums = {ROOT: _ZEROS, **{name: checksum(path.read_bytes()) for name, path in below.items()}}
    document["attributes"][CHECKSUMS] = checksums
    content = json.dumps(document, indent=2).encode()
    own.write_bytes(_with_own(content, _ZEROS, checksum(content)))


def open_group(storage: Storage, folder: str) -> tuple[Any, Mapping[str, str]]:
    """A group of the store, and its checksums, by which the metadata of its arrays is checked as it is read.

    Raises StoreError for a group of another version, FileNotFoundError, and ValueError, KeyError or TypeError for
    metadata that is not what was stored.
    """
    content = storage.read(f"{folder}/{ROOT}")
    attributes = json.loads(content)["attributes"]
    check_version(attributes.get("format"), attributes.get("version"), f"{storage.where}/{folder}", "its zarr.json")
    checksums = {str(name): str(each) for name, each in attributes[CHECKSUMS].items()}
    _check(ROOT, _with_own(content, checksums[ROOT], _ZEROS), checksums)
    store = _Checked(storage.zarr(folder), {name: each for name, each in checksums.items() if name != ROOT})
    return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=False), checksums


def checksum(content: bytes) -> str:
    """The checksum of bytes as it is written."""
    return crc_of(content).hex()


def _with_own(content: bytes, there: str, wanted: str) -> bytes:
    """The bytes of a group's zarr.json with other digits for the checksum of itself."""
    return content.replace(f'"{ROOT}": "{there}"'.encode(), f'"{ROOT}": "{wanted}"'.encode(), 1)


def _check(name: str, content: bytes, checksums: Mapping[str, str]) -> None:
    if checksum(content) != checksums[name]:
        raise ValueError(f"{name} fails its CRC-32C: its bytes are not what was stored")


class _Checked(WrapperStore[Store]):
    """A group whose arrays' metadata is checked as it is read."""

    def __init__(self, store: Store, checksums: Mapping[str, str]) -> None:
        super().__init__(store)
        self._checksums = checksums

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        content = await super().get(key, prototype, byte_range)
        if content is not None and key in self._checksums:
            _check(key, content.to_bytes(), self._checksums)
        return content


class _Part(WrapperStore[LocalStore]):
    """A folder that can be closed to its writers.

    If the disk refuses one of several files, zarr-python raises at once and goes on with the others. They would make
    the part's folder again after its removal.
    """

    def __init__(self, store: LocalStore) -> None:
        super().__init__(store)
        self._changed = threading.Condition()
        self._at_work = 0
        self._has_ended = False

    async def set(self, key: str, value: Buffer) -> None:
        with self._writing(key):
            await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        with self._writing(key):
            await super().set_if_not_exists(key, value)

    def end(self) -> None:
        """Refuse new writes, and wait for those under way."""
        with self._changed:
            self._has_ended = True
            self._changed.wait_for(lambda: not self._at_work)

    @contextlib.contextmanager
    def _writing(self, key: str) -> Iterator[None]:
        with self._changed:
            if self._has_ended:
                raise OSError(errno.ECANCELED, "another file of the group could not be written", key)
            self._at_work += 1
        try:
            yield
        finally:
            with self._changed:
                self._at_work -= 1
                self._changed.notify_all()
