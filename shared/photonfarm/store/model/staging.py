"""A Zarr group that zarr-python writes to a part: once it is whole or has failed, nothing more is written to it.

If the disk refuses one of several files, zarr-python raises at once and goes on with the others. They would make the
part's folder again after its removal.
"""

from __future__ import annotations

import contextlib
import errno
import threading
from collections.abc import Iterator
from pathlib import Path

from zarr.abc.buffer import Buffer
from zarr.abc.store import Store
from zarr.storage import LocalStore, WrapperStore


@contextlib.contextmanager
def group_in(part: Path) -> Iterator[Store]:
    """A store for zarr-python to write a group to; after the block nothing more is written, however it ends."""
    store = _Part(LocalStore(part))
    try:
        yield store
    finally:
        store.end()


class _Part(WrapperStore[LocalStore]):
    """A folder that can be closed to its writers."""

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
