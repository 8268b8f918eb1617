"""What is left of a file or folder that could not be stored: nothing that hides why, and nothing that comes later."""

import asyncio
import errno
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from zarr.abc.buffer import Buffer
from zarr.storage import LocalStore

from photonfarm.store.format.metadata import new_group
from photonfarm.store.io import object_cache
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.io.storage import put_json


@pytest.fixture
def unremovable(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that has become read-only, say."""

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "unlink", refuse)


class Refusing(LocalStorage):
    def adopt(self, part: Path, name: str, *, replace: bool = False) -> bool:  # noqa: ARG002
        raise OSError(errno.EIO, os.strerror(errno.EIO), name)


@pytest.mark.usefixtures("unremovable")
def test_why_a_document_is_not_stored_is_told_though_its_part_cannot_be_removed(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="Input/output error: 'document'"):
        put_json(Refusing(tmp_path), {}, "document")


@pytest.mark.usefixtures("unremovable")
def test_why_an_object_is_not_copied_is_told_though_its_part_cannot_be_removed(tmp_path: Path) -> None:
    cache = object_cache.ObjectCache(tmp_path, 1000)
    with pytest.raises(ZeroDivisionError), cache.filling(cache.path("name", "v")) as file:
        file.write(bytes(1 // 0))


def test_a_group_of_which_a_file_failed_is_written_no_more_once_it_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """zarr-python raises for the first file at once, and goes on with the others, which would make the folder again."""
    plain, written = LocalStore.set, []

    async def slow(self: LocalStore, key: str, value: Buffer) -> None:
        if key == "values/c/0":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), key)
        if "/c/" in key:
            await asyncio.sleep(0.3)
            written.append(key)
        await plain(self, key, value)

    monkeypatch.setattr(LocalStore, "set", slow)
    part = tmp_path / "part"

    def build() -> None:
        with new_group(part, {}) as group:
            array = group.create_array("values", shape=(40,), chunks=(1,), dtype="f4")
            array[:] = np.ones(40)

    with pytest.raises(OSError, match="No space left"):
        build()
    shutil.rmtree(part)
    at_the_end = len(written)
    time.sleep(1)
    assert len(written) == at_the_end
    assert not part.exists()
