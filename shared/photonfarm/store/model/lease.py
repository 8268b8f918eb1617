"""A scene's lease: repair, withdrawal, joining and forgetting have the scene for themselves.

STORE/leases/<scene id>.json            the lease: who has it; placed by whoever comes first
STORE/leases/<scene id>/<token>.json    a process that is at work in the scene: a worker at a job, a trainer

Whoever is at work announces it and then looks for a lease; whoever takes the lease places it and then looks for others
at work. So one of the two always sees the other. Those at work end what they have in hand and wait; the lease waits for
them. Readers who only read are not asked, and nobody waits for them.

Each of these files is renewed every few seconds. One whose process has ended on this machine, or that has not changed
for SILENT_S as this process's clock counts it, is left by the dead and does not count. No two machines' clocks are
compared.
"""

from __future__ import annotations

import errno
import json
import os
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

from photonfarm.core.errors import IncompleteError, StoreError, store_errors
from photonfarm.core.processes import is_gone, process_space, repeat
from photonfarm.store.io.storage import Storage, put_json, read_or_none

LEASES = "leases"

BEAT_S = 5.0
"""The seconds between two renewals."""

SILENT_S = 60.0
"""The seconds without a renewal after which a process on another machine counts as dead."""

LOOK_S = 0.3
"""The seconds between two looks of those who wait."""

_NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT)
"""The errors of a store that cannot be written to, or has no room."""

OnWait = Callable[[str], object]
"""Called with a sentence when what is waited for changes."""

_seen: dict[tuple[str, str], tuple[bytes, float]] = {}
"""What this process last read of each file, by store and name, and when it first read that."""


class LeasedError(IncompleteError):
    """Somebody has the scene for itself at the moment."""


def read_leases(storage: Storage) -> dict[str, str]:
    """Sentences that somebody has a scene for itself, by scene id; costs one listing. Raises StoreError."""
    with store_errors("look for leases", storage.where):
        ids = [name.removesuffix(".json") for name in storage.names(LEASES) if name.endswith(".json")]
        holders = {scene_id: _holder(storage, scene_id) for scene_id in sorted(ids)}
    return {scene_id: f"{holder} has it for itself" for scene_id, holder in holders.items() if holder is not None}


@contextmanager
def announce_work(storage: Storage, scene_id: str, what: str, on_wait: OnWait | None = None) -> Iterator[None]:
    """Announce that this process is at work in a scene, so that a lease waits for the end of the block.

    `what` is in words: "worker w1 at job 12". Where the store cannot be written to, nothing is announced. If
    somebody has the lease, this waits with `on_wait`, and raises LeasedError without. Raises StoreError.
    """
    name = f"{LEASES}/{scene_id}/{uuid.uuid4().hex}.json"
    said = ""
    while True:
        with _announce(storage, name, what):
            with store_errors("look for a lease", storage.where):
                holder = _holder(storage, scene_id)
            if holder is None:
                yield
                return
        sentence = f"scene {scene_id}: {holder} has it for itself"
        if on_wait is None:
            raise LeasedError(sentence)
        if sentence != said:
            on_wait(f"{sentence}; waiting")
            said = sentence
        time.sleep(LOOK_S)


@contextmanager
def hold_lease(storage: Storage, scene_id: str, what: str, on_wait: OnWait) -> Iterator[Claim]:
    """Have a scene alone: wait for others' leases and for all who are at work in it, and hold it during the block.

    `what` is in words: "store check --repair". Raises StoreError.
    """
    said = ""

    def wait_for(others: list[str]) -> None:
        nonlocal said
        sentence = f"scene {scene_id}: {what} waits for {', '.join(others)}"
        if sentence != said:
            on_wait(sentence)
            said = sentence
        time.sleep(LOOK_S)

    while True:
        claim = Claim(storage, f"{LEASES}/{scene_id}.json", what)
        with store_errors("take the scene's lease", storage.where):
            while not claim.place():
                if (holder := _holder(storage, scene_id)) is not None:
                    wait_for([holder])
                else:
                    _remove_dead(storage, scene_id)
        with claim.renewed():
            while others := _others_at_work(storage, scene_id):
                wait_for(others)
            if claim.is_own():
                yield claim
                return


def _remove_dead(storage: Storage, scene_id: str) -> None:
    """Remove a lease that the dead have left: of those who try, one moves it away; one that is alive is put back."""
    name, away = f"{LEASES}/{scene_id}.json", f"{LEASES}/{scene_id}/{uuid.uuid4().hex}.json"
    dead = _seen.get((storage.where, name))
    with suppress(FileNotFoundError, FileExistsError):
        storage.move(name, away)
        if dead is None or storage.read(away) != dead[0]:
            storage.move(away, name)
        else:
            storage.delete(away)


def _others_at_work(storage: Storage, scene_id: str) -> list[str]:
    """Who is at work in a scene, in words; what the dead have left is removed."""
    folder, others = f"{LEASES}/{scene_id}", []
    with store_errors("look who is at work in the scene", storage.where):
        for name in sorted(storage.names(folder)):
            if (who := _owner(storage, f"{folder}/{name}")) is not None:
                others.append(who)
            else:
                storage.delete(f"{folder}/{name}")
    return others


def _holder(storage: Storage, scene_id: str) -> str | None:
    return _owner(storage, f"{LEASES}/{scene_id}.json")


def _owner(storage: Storage, name: str) -> str | None:
    """The process that keeps a file, in words; None if there is no file, or the process is dead."""
    key, content = (storage.where, name), read_or_none(storage, name)
    if content is None:
        _seen.pop(key, None)
        return None
    if key not in _seen or _seen[key][0] != content:
        _seen[key] = content, time.monotonic()
    try:
        document: dict[str, Any] = json.loads(content)
        what, space, process = str(document["what"]), str(document["space"]), int(document["process"])
    except (ValueError, KeyError, TypeError):
        what, space, process = f"whoever wrote {name}, which names nobody", "", 0
    silent_s = time.monotonic() - _seen[key][1]
    if silent_s > SILENT_S or (space == process_space() and is_gone(process)):
        return None
    silent = ", silent" if silent_s > 3 * BEAT_S else ""
    return f"{what} ({space.rpartition('-')[0]}, process {process}{silent})" if space else what


class Claim:
    """A lease, or an announcement of work: a file of this process, which it renews."""

    def __init__(self, storage: Storage, name: str, what: str) -> None:
        self._storage, self._name, self._what = storage, name, what
        self._token, self._beat = uuid.uuid4().hex, 0

    def place(self) -> bool:
        """Place the file; False if there is one."""
        document = {
            "what": self._what,
            "space": process_space(),
            "process": os.getpid(),
            "token": self._token,
            "beat": self._beat,
        }
        return put_json(self._storage, document, self._name, replace=self._beat > 0)

    def is_own(self) -> bool:
        """Whether the file is there and this one's."""
        content = read_or_none(self._storage, self._name)
        return content is not None and self._token.encode() in content

    def check(self) -> None:
        """Raise StoreError if others took the file for that of the dead: before anything that cannot be undone."""
        if not self.is_own():
            raise StoreError(f"{self._what} was silent for so long that others went on; start it again")

    def _renew(self) -> None:
        with suppress(OSError):  # a full disk, say: others wait SILENT_S before they take this process for dead
            if self.is_own():
                self._beat += 1
                self.place()

    @contextmanager
    def renewed(self) -> Iterator[None]:
        """Renew the file in a thread of its own, and remove it at the end."""
        try:
            with repeat(BEAT_S, self._renew):
                yield
        finally:
            with suppress(OSError):
                if self.is_own():
                    self._storage.delete(self._name)


def _announce(storage: Storage, name: str, what: str) -> AbstractContextManager[None]:
    file = Claim(storage, name, what)
    try:
        with store_errors("announce work in a scene", storage.where):
            file.place()
    except StoreError as error:
        if getattr(error.__cause__, "errno", None) not in _NOT_WRITABLE:
            raise
        return nullcontext()
    return file.renewed()
