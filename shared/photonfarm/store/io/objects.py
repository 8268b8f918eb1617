"""A store in a bucket: safe for any number of machines, without locks, where the server honours `If-None-Match: *`.

An object appears whole or not at all. A name is given by a conditional put, so the first one stays. A put whose
response was lost is tried again, and may then be refused because of itself; so every object carries the id of the put
that made it, by which a writer recognises its own. A refused put of a name without an object (S3 answers so while
another put is under way, which may yet fail) is tried again as well. `settle` has nothing to do: an answered put is
durable. All puts are single ones (at most 5 GB on S3), so no half of an upload is ever left in the bucket.

A folder (a plan, the base) cannot be renamed, and is claimed instead. `FOLDER.claim` is one object, a zip of all the
folder's files, placed by a conditional put: from then on what the folder will hold is decided, for good. Then the files
are put under their names, `zarr.json` of the folder last, which is what readers look for. A process that finds a folder
claimed but not complete first completes it from the claim. So two submitters never mix their files; if one dies after
its claim, the next one completes it; and if one sleeps for however long, it finds on waking that all of its files are
there already, with the same bytes. Claims stay, so that a process that has slept cannot claim later.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import threading
import uuid
import zipfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import obstore
from obstore.exceptions import AlreadyExistsError, PreconditionError
from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest
from zarr.storage import ObjectStore

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.store.io.object_cache import ObjectCache
from photonfarm.store.io.object_requests import connect, os_errors, patiently
from photonfarm.store.io.storage import AT_ONCE, FORMAT_FILE, STRAY_AGE_S, TMP, discard

if TYPE_CHECKING:
    from obstore import ObjectMeta, PutMode, UpdateVersion

SMALL_BYTES = 4 << 20
"""The largest size of an object that counts as small."""

TIMEOUT_S = 30.0
"""The time limit of a small request, with its answer."""

TRANSFER_TIMEOUT_S = 300.0
"""The time limit of a larger request: enough for a shard of 256 MB at 1 MB/s."""

TRANSFER_TIMES = 2
"""The attempts at a larger request."""

REPLACED_TIMES = 4
"""The attempts to fetch an object that another process replaces meanwhile."""

WRITER = "writer"
"""The metadata field with a put's id; letters alone, as not every service takes more."""

PROBE = f"{TMP}/conditional-put"
ROOT = "zarr.json"


class ObjectStorage:
    """`storage.Storage` in a bucket, below a prefix. Endpoint and credentials come from the usual variables."""

    lists_behind = True

    def __init__(self, url: str) -> None:
        """Take the bucket, without a request. Raises StoreError for an invalid URL."""
        self._url = url.rstrip("/")
        self._objects = connect(self._url, TIMEOUT_S)
        self._transfers = connect(self._url, TRANSFER_TIMEOUT_S)
        self._cache = ObjectCache.of(self._url)
        self._transfer = threading.Lock()
        self._is_conditional = False

    @property
    def where(self) -> str:
        """The URL."""
        return self._url

    # ---------------------------------------------------------------------------------------------------------- reading

    def local(self, name: str) -> Path:
        """A copy on this machine, fetched if there is none of the object's current version; always costs a request."""
        return self._copy(name)

    def renew(self, name: str) -> bool:
        """Fetch an object again: this machine's copy of it is or may be damaged."""
        self._copy(name, anew=True)
        return True

    def _copy(self, name: str, *, anew: bool = False) -> Path:
        with os_errors(name):
            for _ in range(REPLACED_TIMES):
                try:
                    return patiently(lambda: self._copy_once(name, anew=anew), times=TRANSFER_TIMES)
                except FileNotFoundError:
                    return self._cache.path(name, None)  # where nothing is, as whoever opens it learns
                except PreconditionError:  # replaced in the meantime
                    continue
        raise OSError(errno.EAGAIN, "is being replaced again and again", name)

    def _copy_once(self, name: str, *, anew: bool) -> Path:
        about = obstore.head(self._objects, name)
        copy = self._cache.path(name, _version(about))
        if anew or not self._cache.has(copy, about["size"]):
            self._fetch(name, about, copy)
        return copy

    def _fetch(self, name: str, about: ObjectMeta, copy: Path) -> None:
        with self._cache.filling(copy) as file:
            options: Any = {"if_match": about["e_tag"]} if about["e_tag"] else {}
            for chunk in obstore.get(self._transfers, name, options=options).stream(SMALL_BYTES):
                file.write(chunk)
            if file.tell() != about["size"]:
                raise OSError(errno.EIO, f"{file.tell()} of {about['size']} bytes came", name)

    def read(self, name: str) -> bytes:
        """The bytes of a name; raises FileNotFoundError."""
        with os_errors(name):
            return patiently(lambda: bytes(obstore.get(self._objects, name).bytes()))

    def exists(self, name: str) -> bool:
        """Whether there is an object of this name."""
        try:
            self.size(name)
        except FileNotFoundError:
            return False
        return True

    def size(self, name: str) -> int:
        """The size of an object in bytes; raises FileNotFoundError."""
        with os_errors(name):
            return patiently(lambda: obstore.head(self._objects, name)["size"])

    def names(self, folder: str) -> list[str]:
        """The names right below a folder; none if it does not exist. Costs a request per thousand names.

        Raises StoreError if the store is gone; an empty answer costs a request more to check that.
        """
        try:
            with os_errors(folder):
                listing = patiently(lambda: obstore.list_with_delimiter(self._objects, folder or None))
        except FileNotFoundError:  # not even a bucket
            listing = {"common_prefixes": [], "objects": []}
        paths = [*listing["common_prefixes"], *(about["path"] for about in listing["objects"])]
        if folder and not paths:  # the root is listed to see whether anything is there
            self.require()
        return [path.rpartition("/")[2] for path in paths]

    def names_behind(self, folder: str, name: str) -> list[str]:
        """The names right below a folder without folders that come after a name, which need not be there.

        Costs a request per thousand of these names. There are none if the store is gone.
        """
        return [path.rpartition("/")[2] for path in self._below(folder, f"{folder}/{name}")]

    def zarr(self, folder: str) -> ObjectStore[Any]:
        """A folder in the form that zarr-python reads."""
        return _Group(connect(f"{self._url}/{folder}", TIMEOUT_S), read_only=True)

    # ---------------------------------------------------------------------------------------------------------- writing

    def part(self) -> Path:
        """A new path in the cache's folder."""
        return self._cache.part()

    def adopt(self, part: Path, name: str, *, replace: bool = False) -> bool:
        """Put a part under its name; False if the name was taken."""
        self.check()
        if not self._put(part, name, replace=replace):
            return False
        part.unlink()
        return True

    def adopt_folder(self, part: Path, folder: str) -> bool:
        """Claim a folder's name and complete it; False if another claim has taken the name, which is then completed."""
        self.check()
        self.require()
        if self.exists(f"{folder}/{ROOT}"):
            return False
        packed = self.part()
        try:
            _pack(part, packed)
            if ours := self._put(packed, claim_of(folder)):
                self._complete(folder, packed)
            else:
                self._complete(folder, self._copy(claim_of(folder), anew=True))  # it decides for good: no damaged copy
        finally:
            discard(packed)
        return ours

    def _complete(self, folder: str, packed: Path) -> None:
        """Put the files of a claim that are missing; any number of machines may do so at once."""
        try:
            with zipfile.ZipFile(packed) as claim:
                names = claim.namelist()
                if names[-1:] != [ROOT] or any(".." in PurePosixPath(name).parts for name in names):
                    raise CorruptError(f"{self._url}/{claim_of(folder)}: is not a claim")
                with ThreadPoolExecutor(AT_ONCE) as pool:
                    list(pool.map(lambda name: self._put(claim.read(name), f"{folder}/{name}"), names[:-1]))
                self._put(claim.read(ROOT), f"{folder}/{ROOT}")
        except zipfile.BadZipFile as error:
            raise CorruptError(f"{self._url}/{claim_of(folder)}: is not a readable claim: {error}") from error

    def move(self, name: str, new_name: str) -> None:
        """Copy an object within the bucket, and delete the original; raises FileNotFoundError."""
        if self.exists(new_name):
            raise FileExistsError(errno.EEXIST, "is there already", new_name)
        with os_errors(name):
            patiently(lambda: obstore.copy(self._objects, name, new_name))
            patiently(lambda: obstore.delete(self._objects, name))

    def move_folder(self, folder: str, new_folder: str) -> None:
        """Move all objects below a folder, its own `zarr.json` first, and its claim last, so that it can be claimed.

        This is not atomic: if other processes complete the folder from its claim meanwhile, it may lack objects that
        were moved after they had seen them.
        """
        self.move(f"{folder}/{ROOT}", f"{new_folder}/{ROOT}")
        for name in self._below(folder):
            self.move(name, new_folder + name.removeprefix(folder))
        if self.exists(claim_of(folder)):
            self.move(claim_of(folder), claim_of(new_folder))

    def delete(self, name: str) -> None:
        """Delete an object, if it is there."""
        with contextlib.suppress(FileNotFoundError), os_errors(name):
            patiently(lambda: obstore.delete(self._objects, name))

    def delete_folder(self, folder: str) -> None:
        """Delete all objects below a folder, its claim included."""
        for name in self._below(folder):
            self.delete(name)

    def _below(self, folder: str, offset: str | None = None) -> list[str]:
        """The names of all objects below a folder, or of those that come after an offset."""
        with os_errors(folder):
            return patiently(
                lambda: [
                    about["path"] for batch in obstore.list(self._objects, folder, offset=offset) for about in batch
                ]
            )

    def settle(self, names: Iterable[str]) -> None:
        """Return at once: what has been put is durable."""

    def check(self) -> None:
        """Raise StoreError for a server that ignores conditional puts: workers would undo each other's commits.

        Raises OSError if the server cannot be written to. Sends a request once, before the first put.
        """
        if not self._is_conditional:
            if self._put(b"", PROBE) and self._put(b"", PROBE):
                raise StoreError(f"{self._url}: the server ignores `If-None-Match: *`; a store cannot be kept there")
            self._is_conditional = True

    def _put(self, content: Path | bytes, name: str, *, replace: bool = False) -> bool:
        """Put an object if there is none, or with `replace` in place of the current one; False if that is refused.

        It is tried for PATIENCE_S while the server fails, or refuses for another put that may fail. The replaced object
        is identified by its tag, so that a put that arrives late cannot undo a later one. Of larger objects one is put
        at a time: they would share the bandwidth that their time limit counts on, and lie in memory together.
        """
        writer = uuid.uuid4().hex
        size = content.stat().st_size if isinstance(content, Path) else len(content)
        is_small = size <= SMALL_BYTES
        objects = self._objects if is_small else self._transfers

        def attempt() -> bool:
            mode: PutMode = self._mode(name) if replace else "create"
            try:
                with contextlib.nullcontext() if is_small else self._transfer:
                    obstore.put(objects, name, content, mode=mode, attributes={WRITER: writer}, use_multipart=False)
            except (AlreadyExistsError, PreconditionError):
                holder = self._writer(name)
                if holder == writer:
                    return True
                if holder is not None and not replace:
                    return False
                raise  # and try again: there is no object yet, or the one to be replaced is another by now
            return True

        with os_errors(name):
            times = 1 if is_small else TRANSFER_TIMES
            return patiently(attempt, AlreadyExistsError, PreconditionError, times=times)

    def _mode(self, name: str) -> PutMode:
        """The put mode that replaces the current object."""
        try:
            about = obstore.head(self._objects, name)
        except FileNotFoundError:
            return "create"
        tags: UpdateVersion = {"e_tag": about["e_tag"]}
        return {**tags, "version": about["version"]} if about["version"] else tags

    def _writer(self, name: str) -> str | None:
        """The id of the put that made an object, "" if it has none; None if there is no object."""
        try:
            answer = obstore.get(self._objects, name, options={"head": True})
        except FileNotFoundError:
            return None
        return answer.attributes.get(WRITER, "")

    # --------------------------------------------------------------------------------------------------------- sweeping

    def sweep(self, *, stray_age_s: float = STRAY_AGE_S) -> int:
        """Remove parts that dead writers left on this machine; returns how many. The bucket holds none."""
        return self._cache.sweep(stray_age_s=stray_age_s)

    # -------------------------------------------------------------------------------------------------------- its root

    def founding(self) -> contextlib.AbstractContextManager[None]:
        """Do nothing: a bucket is there, or refuses every put."""
        return contextlib.nullcontext()

    def require(self) -> None:
        """Raise StoreError if the format file is missing: the bucket, or all below its prefix, was deleted.

        It costs a request. So puts do not check it, but folders do, and a commit does once for all of its files.
        """
        if not self.exists(FORMAT_FILE):
            raise StoreError(
                f"{self._url}: the store is gone (moved or deleted?): {FORMAT_FILE} is not there any more; bring it "
                "back, then start again: what was committed in it needs nothing else"
            )


class _Group(ObjectStore[Any]):
    """zarr-python's store of objects, with the errors of a file system."""

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        with os_errors(key):
            return await super().get(key, prototype, byte_range)

    async def exists(self, key: str) -> bool:
        with os_errors(key):
            return await super().exists(key)


def claim_of(folder: str) -> str:
    """The name of the object that decides a folder's content."""
    return f"{folder}.claim"


def _pack(folder: Path, packed: Path) -> None:
    """Zip a folder's files, uncompressed, in order, its own `zarr.json` last."""
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    files.sort(key=lambda name: name == ROOT)
    with zipfile.ZipFile(packed, "w") as claim:
        for name in files:
            claim.write(folder / name, name)


def _version(about: ObjectMeta) -> str:
    """A text that changes with an object's bytes."""
    version = about["e_tag"] or f"{about['last_modified']} {about['size']}"
    return hashlib.sha256(version.encode()).hexdigest()[:16]
