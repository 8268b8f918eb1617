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
from contextlib import contextmanager, suppress
from typing import Any

from photonfarm.shared.core.errors import IncompleteError, StoreError, store_errors
from photonfarm.shared.core.processes import is_gone, process_space, repeating
from photonfarm.shared.store.io.storage import Storage, put_json, read_or_none

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


def leases(storage: Storage) -> dict[str, str]:
    """Sentences that somebody has a scene for itself, by scene id; costs one listing. Raises StoreError."""
    with store_errors("look for leases", storage.where):
        ids = [name.removesuffix(".json") for name in storage.names(LEASES) if name.endswith(".json")]
        found = {scene_id: _holder(storage, scene_id) for scene_id in sorted(ids)}
    return {scene_id: f"{holder} has it for itself" for scene_id, holder in found.items() if holder is not None}


@contextmanager
def at_work(storage: Storage, scene_id: str, what: str, on_wait: OnWait | None = None) -> Iterator[None]:
    """Announce that this process is at work in a scene, so that a lease waits for the end of the block.

    `what` is in words: "worker w1 renders job 12". Where the store cannot be written to, nothing is announced. If
    somebody has the lease, this waits with `on_wait`, and raises LeasedError without. Raises StoreError.
    """
    name = f"{LEASES}/{scene_id}/{uuid.uuid4().hex}.json"
    said = ""
    while True:
        with _announced(storage, name, what):
            with store_errors("look for a lease", storage.where):
                holder = _holder(storage, scene_id)
            if holder is None:
                yield
                return
        sentence = f"scene {scene_id}: {holder} has it for itself"
        if on_wait is None:
            raise LeasedError(f"{sentence}; go on when that has ended")
        if sentence != said:
            on_wait(f"{sentence}; waiting")
            said = sentence
        time.sleep(LOOK_S)


@contextmanager
def lease(storage: Storage, scene_id: str, what: str, on_wait: OnWait) -> Iterator[None]:
    """Have a scene alone: wait for others' leases and for all who are at work in it, and hold it during the block.

    `what` is in words: "store check --repair". Raises StoreError.
    """
    name = f"{LEASES}/{scene_id}.json"
    said = ""

    def wait_for(others: list[str]) -> None:
        nonlocal said
        sentence = f"scene {scene_id}: {what} waits for {', '.join(others)}"
        if sentence != said:
            on_wait(sentence)
            said = sentence
        time.sleep(LOOK_S)

    with store_errors("take the scene's lease", storage.where):
        while not _place(storage, name, what, 0):
            if (holder := _holder(storage, scene_id)) is not None:
                wait_for([holder])
            else:
                storage.delete(name)  # left by the dead
    with _renewed(storage, name, what):
        while others := _others_at_work(storage, scene_id):
            wait_for(others)
        yield


def _others_at_work(storage: Storage, scene_id: str) -> list[str]:
    """Who is at work in a scene, in words; what the dead have left is removed."""
    folder, found = f"{LEASES}/{scene_id}", []
    with store_errors("look who is at work in the scene", storage.where):
        for name in sorted(storage.names(folder)):
            if (who := _owner(storage, f"{folder}/{name}")) is not None:
                found.append(who)
            else:
                storage.delete(f"{folder}/{name}")
    return found


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
        what, space, process = "somebody unknown", "", 0
    silent_s = time.monotonic() - _seen[key][1]
    if silent_s > SILENT_S or (space == process_space() and is_gone(process)):
        return None
    host = space.rpartition("-")[0]
    return f"{what} ({host}, process {process}{f', silent for {silent_s:.0f} s' if silent_s > 3 * BEAT_S else ''})"


@contextmanager
def _announced(storage: Storage, name: str, what: str) -> Iterator[None]:
    try:
        with store_errors("announce work in a scene", storage.where):
            _place(storage, name, what, 0)
    except StoreError as error:
        if getattr(error.__cause__, "errno", None) not in _NOT_WRITABLE:
            raise
        yield
        return
    with _renewed(storage, name, what):
        yield


@contextmanager
def _renewed(storage: Storage, name: str, what: str) -> Iterator[None]:
    """Renew a file in a thread of its own, and remove it at the end."""
    beat = 0

    def renew() -> None:
        nonlocal beat
        beat += 1
        with suppress(OSError):  # a full disk, say: others wait SILENT_S before they take this process for dead
            _place(storage, name, what, beat)

    try:
        with repeating(BEAT_S, renew):
            yield
    finally:
        with suppress(OSError):
            storage.delete(name)


def _place(storage: Storage, name: str, what: str, beat: int) -> bool:
    document = {"what": what, "space": process_space(), "process": os.getpid(), "beat": beat}
    return put_json(storage, document, name, replace=beat > 0)
