"""The checksums of a Zarr group's metadata: its attribute `checksums` has one of each zarr.json in it.

Each is the CRC-32C of the file's bytes; that of the group's own zarr.json, which holds them, is of its bytes with zeros
for the digits of that one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zarr
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from photonfarm.store.format.declarations import check_version
from photonfarm.store.format.shards import crc_of

if TYPE_CHECKING:
    from photonfarm.store.io.storage import Storage

CHECKSUMS = "checksums"
ROOT = "zarr.json"
_ZEROS = "0" * 8


def seal(folder: Path) -> None:
    """Write the checksums into a new group that is otherwise complete."""
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
