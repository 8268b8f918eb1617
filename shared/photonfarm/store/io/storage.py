"""Where the files of a store lie: names with bytes, each written once, whole, and by whichever process comes first.

A name is a path below the store, with / between its parts. New content is written to a `part` on this machine and
adopted under its name; after `settle` it survives a failure of the machine. `local` keeps a store in a folder on a
POSIX file system; `objects` in a bucket.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from photonfarm.core.errors import CorruptError, StoreError, say_install, store_errors

if TYPE_CHECKING:
    import zarr.abc.store

FORMAT_FILE = "photonfarm.json"
"""The file at the root of every store, by which it is recognised."""

TMP = "tmp"
"""The folder of parts that are not adopted yet."""

STRAY_AGE_S = 60.0
"""The age at which parts left by a dead process of this machine are removed."""

FOREIGN_AGE_S = 86400.0
"""The age at which parts from other machines are removed; their processes cannot be checked."""

AT_ONCE = 8
"""The files that are made durable, or are put, at once: each alone waits for the disk or the bucket."""


class Storage(Protocol):
    """Files by name. Any method may raise OSError; none leaves half a file under a name."""

    @property
    def where(self) -> str:
        """The store's folder or URL, for messages."""

    lists_behind: bool
    """Whether names are listed in order, so that listing those behind a name costs nothing for those before it."""

    def local(self, name: str) -> Path:
        """A file of this machine with the bytes of a name; it may be missing if the name is."""

    def renew(self, name: str) -> bool:
        """Make this machine's damaged copy of a name again; False if `local` gives the file itself."""

    def read(self, name: str) -> bytes:
        """The bytes of a name; raises FileNotFoundError."""

    def exists(self, name: str) -> bool:
        """Whether there are bytes under a name."""

    def size(self, name: str) -> int:
        """The number of bytes under a name; raises FileNotFoundError."""

    def names(self, folder: str) -> list[str]:
        """The last parts of the names and folders right below a folder, in no order; none if it does not exist."""

    def names_behind(self, folder: str, name: str) -> list[str]:
        """The names right below a folder without folders that come after a name, which need not be there."""

    def zarr(self, folder: str) -> zarr.abc.store.Store:
        """A folder in the form that zarr-python reads."""

    def part(self) -> Path:
        """A new path on this machine for a file or folder that will be adopted or removed."""

    def adopt(self, part: Path, name: str, *, replace: bool = False) -> bool:
        """Give a part its name; False if the name was taken, which leaves both as they are.

        With `replace` it takes the place of what is there, atomically.
        """

    def adopt_folder(self, part: Path, folder: str) -> bool:
        """Give a folder that is a Zarr group its name, atomically; False if it was taken, which keeps the part."""

    def move(self, name: str, new_name: str) -> None:
        """Rename; the new name must be free. Raises FileNotFoundError.

        The bytes are never without a name; in between they may have both.
        """

    def move_folder(self, folder: str, new_folder: str) -> None:
        """Rename all names below a folder that is a Zarr group into another folder, which must not exist.

        The group's own zarr.json goes first, if not all go at once. Raises FileNotFoundError if there is none.
        """

    def delete(self, name: str) -> None:
        """Remove a name, if it is there."""

    def delete_folder(self, folder: str) -> None:
        """Remove all names below a folder, if there are any; not at once in a bucket."""

    def settle(self, names: Iterable[str]) -> None:
        """Return once these names are as durable as their bytes."""

    def sweep(self, *, stray_age_s: float = STRAY_AGE_S) -> int:
        """Remove parts that dead writers left; returns how many."""

    def founding(self) -> contextlib.AbstractContextManager[None]:
        """Allow writing while a store is being made: otherwise nothing is written without its format file."""

    def require(self) -> None:
        """Raise StoreError if the store is gone, so that its files are not taken for missing."""


T = TypeVar("T")


def look_into(storage: Storage, name: str, look: Callable[[Path], T]) -> T:
    """What `look` gives for a file of the store; if it finds a damaged copy of this machine, for a new copy.

    Raises CorruptError if the store's own bytes are damaged.
    """
    try:
        return look(storage.local(name))
    except CorruptError:
        if not storage.renew(name):
            raise
    return look(storage.local(name))


SCHEMES = ("s3", "gs", "az")
"""The schemes of bucket URLs."""


def is_url(root: str | Path) -> bool:
    """Whether a store's place is written as a URL."""
    return isinstance(root, str) and "://" in root


def open_storage(root: str | Path) -> Storage:
    """The storage of a folder's path or of a bucket's URL, which need not exist yet; raises StoreError for others."""
    if not is_url(root):
        from photonfarm.store.io.local import LocalStorage

        return LocalStorage(Path(root), FORMAT_FILE)
    if str(root).partition("://")[0] not in SCHEMES:
        raise StoreError(f"{root}: is no URL of a bucket; they begin with {'://, '.join(SCHEMES)}://")
    try:
        from photonfarm.store.io.objects import ObjectStorage
    except ModuleNotFoundError as error:
        raise StoreError(
            f"{root}: a store in a bucket needs the package {error.name}; {say_install('bucket')}"
        ) from error
    return ObjectStorage(str(root))


def is_vacant(root: str | Path) -> bool:
    """Whether the place of a store is empty, so that one may be made there; raises StoreError."""
    storage = open_storage(root)
    with store_errors("look into the store", storage.where):
        return set(storage.names("")) <= {TMP}


def read_or_none(storage: Storage, name: str) -> bytes | None:
    """The bytes of a name; None if there are none."""
    try:
        return storage.read(name)
    except FileNotFoundError:
        return None


def discard(part: Path) -> None:
    """Remove a part if it is still there; if the disk refuses, a sweep removes it later.

    A refusal is not raised: it would hide the error under way, or make a completed adoption look failed.
    """
    with contextlib.suppress(OSError):
        part.unlink(missing_ok=True)


def put_json(storage: Storage, document: dict[str, Any], name: str, *, replace: bool = False) -> bool:
    """Store a JSON document durably; False if the name was taken, which keeps the old document unless `replace`."""
    content = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    return put_bytes(storage, content.encode(), name, replace=replace)


def put_bytes(storage: Storage, content: bytes, name: str, *, replace: bool = False) -> bool:
    """Store some bytes durably; False if the name was taken, which keeps the old ones unless `replace`."""
    part = storage.part()
    try:
        part.write_bytes(content)
        placed = storage.adopt(part, name, replace=replace)
    finally:
        discard(part)
    storage.settle([name])
    return placed
