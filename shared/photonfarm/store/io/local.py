"""A store in a folder: safe for any number of processes and machines on one POSIX file system, without locks.

A file is written under a temporary name in `tmp`, synced, and linked to its final name, so that a final name is always
a whole file, and the first one stays. Folders are synced before anything announces their files.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from photonfarm.core.errors import StoreError
from photonfarm.core.processes import is_gone, process_space
from photonfarm.store.io.storage import AT_ONCE, FOREIGN_AGE_S, STRAY_AGE_S, TMP

if TYPE_CHECKING:
    from zarr.storage import LocalStore

_counter = itertools.count()


class LocalStorage:
    """`storage.Storage` in a folder, which need not exist yet."""

    lists_behind = False

    def __init__(self, root: Path, mark: str | None = None) -> None:
        """Take the folder, and the name of a file in it without which it counts as gone; None: it may be made."""
        self.root = root
        self._mark = mark
        self._is_founding = mark is None

    @property
    def where(self) -> str:
        """The folder."""
        return str(self.root)

    # ---------------------------------------------------------------------------------------------------------- reading

    def local(self, name: str) -> Path:
        """The file itself."""
        return self.root / name

    def renew(self, name: str) -> bool:  # noqa: ARG002
        """Do nothing: there are no copies."""
        return False

    def read(self, name: str) -> bytes:
        """The bytes of a name; raises FileNotFoundError."""
        return (self.root / name).read_bytes()

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (self.root / name).is_file()

    def size(self, name: str) -> int:
        """The size of a file in bytes; raises FileNotFoundError."""
        return (self.root / name).stat().st_size

    def names(self, folder: str) -> list[str]:
        """The names right below a folder; none if it does not exist. Raises StoreError if the store is gone."""
        try:
            return [path.name for path in (self.root / folder).iterdir()]
        except FileNotFoundError:
            if folder:  # the root is listed to see whether anything is there
                self.require()
            return []

    def names_behind(self, folder: str, name: str) -> list[str]:
        """The names right below a folder that come after a name."""
        return [each for each in self.names(folder) if each > name]

    def zarr(self, folder: str) -> LocalStore:
        """A folder in the form that zarr-python reads."""
        from zarr.storage import LocalStore

        return LocalStore(self.root / folder, read_only=True)

    # ---------------------------------------------------------------------------------------------------------- writing

    def part(self) -> Path:
        """A new path in `tmp` whose name states its owner: host, process space, process, number, time."""
        tmp = self.root / TMP
        if not tmp.is_dir():  # the store may be gone, which is checked again before anything is adopted
            self.require()
            self._make_folder(self.root)
            tmp.mkdir(exist_ok=True)
        return tmp / f"{process_space()}-{os.getpid()}-{next(_counter)}-{time.time_ns():x}.partial"

    def adopt(self, part: Path, name: str, *, replace: bool = False) -> bool:
        """Sync a part and link it to its name; False if the name was taken."""
        self.require()
        final = self.root / name
        self._make_folder(final.parent)
        sync(part, data_only=True)
        if replace:
            part.replace(final)
            return True
        try:
            os.link(part, final)
        except FileExistsError:
            return False
        part.unlink()
        return True

    def adopt_folder(self, part: Path, folder: str) -> bool:
        """Sync a folder with all that is in it, and rename it; False if the name was taken."""
        self.require()
        final = self.root / folder
        _sync_tree(part)
        self._make_folder(final.parent)
        try:
            part.rename(final)  # fails if the folder exists, since a folder of ours is never empty
        except OSError:
            if not final.is_dir():
                raise
            return False
        sync(final.parent)
        return True

    def move(self, name: str, new_name: str) -> None:
        """Rename a file; raises FileNotFoundError."""
        self.require()
        final = self.root / new_name
        self._make_folder(final.parent)
        if final.exists():  # a rename would replace it
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(final))
        (self.root / name).rename(final)

    def move_folder(self, folder: str, new_folder: str) -> None:
        """Rename a folder, at once; raises FileNotFoundError."""
        self.move(folder, new_folder)

    def delete(self, name: str) -> None:
        """Remove a file, if it is there."""
        (self.root / name).unlink(missing_ok=True)

    def delete_folder(self, folder: str) -> None:
        """Remove a folder, if it is there: first its name, at once, then what is in it."""
        self.require()
        part = self.part()
        with contextlib.suppress(FileNotFoundError):
            (self.root / folder).rename(part)
            sync((self.root / folder).parent)
            shutil.rmtree(part)

    def settle(self, names: Iterable[str]) -> None:
        """Sync the folders that the names are in."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(sync, {(self.root / name).parent for name in names}))

    def _make_folder(self, folder: Path) -> None:
        """Make a missing folder durably, with its parents; never the root of a store that is gone."""
        if folder.is_dir():
            return
        if folder == self.root and not self._is_founding:
            raise self._gone()
        self._make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync(folder.parent)

    # -------------------------------------------------------------------------------------------------------- its root

    @contextlib.contextmanager
    def founding(self) -> Iterator[None]:
        """Make the folder, and allow writing before it has its mark."""
        was, self._is_founding = self._is_founding, True
        try:
            yield
        finally:
            self._is_founding = was

    def require(self) -> None:
        """Raise StoreError if the mark is not there: an empty mount point, a folder that was moved or deleted."""
        if not self._is_founding and not self.exists(str(self._mark)):
            raise self._gone()

    def _gone(self) -> StoreError:
        return StoreError(
            f"{self.root}: the store is gone (unmounted, moved or deleted?): {self._mark} is not there any more; bring "
            "it back, then start again: what was committed in it needs nothing else"
        )

    # --------------------------------------------------------------------------------------------------------- sweeping

    def sweep(self, *, stray_age_s: float = STRAY_AGE_S) -> int:
        """Remove parts that dead writers left; returns how many. Parts that belong to other users stay."""
        if not (names := self.names(TMP)):
            return 0
        tmp, swept = self.root / TMP, 0
        os.utime(tmp)  # its time is set as the parts' are, perhaps by a file server's clock far from ours
        now_s = tmp.stat().st_mtime
        for name in names:
            path = tmp / name
            with contextlib.suppress(OSError):  # another sweep was faster, or only its owner may remove it
                age_s = now_s - path.stat().st_mtime
                if age_s > FOREIGN_AGE_S or (age_s >= stray_age_s and _is_of_the_dead(name)):
                    _remove(path)
                    swept += 1
        return swept


def _is_of_the_dead(name: str) -> bool:
    owner, *numbers = name.rsplit("-", 3)  # from the right: a host's name may hold any number of -
    if owner != process_space():
        return False  # of another machine or container
    return numbers[0].isdecimal() and is_gone(int(numbers[0]))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def sync(path: Path, *, data_only: bool = False) -> None:
    """Make a file's bytes durable, or the names in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        (os.fdatasync if data_only else os.fsync)(descriptor)
    finally:
        os.close(descriptor)


def _sync_tree(folder: Path) -> None:
    """Make a folder durable with everything below it."""
    for path, _, files in os.walk(folder):
        for name in files:
            sync(Path(path, name))
        sync(Path(path))
