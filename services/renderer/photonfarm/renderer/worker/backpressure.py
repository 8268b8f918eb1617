"""Reasons for a worker to take no job: the disk is nearly full, or the trainer is far behind.

Neither makes a job fail, and both end by themselves. They hold back jobs that have not begun; the job in hand is
finished.
"""

from __future__ import annotations

import errno
import shutil
import time
from collections.abc import Callable

from redis import Redis

from photonfarm.core.errors import store_errors
from photonfarm.core.waiting import pause_after_look
from photonfarm.queue.workers import read_consumed
from photonfarm.store import SceneStore, Store
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.model.scene_store import Progress

AHEAD_MINIMUM = 256
"""The samples that may be committed before any is used, as a trainer first waits for some, held-out ones included."""

AHEAD_LOOK_S = 5.0
"""The seconds between two counts of committed samples, since each count looks at the markers."""

FULL_S = 30.0
"""The seconds for which no job is taken after a disk refused a commit, even if it seems to have free space."""


class DiskReserve:
    """Keeps some of a store's disk free; a store that is not on a local disk has no limit."""

    def __init__(self, store: Store, reserve_bytes: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Take a store and the number of bytes of its disk that must stay free."""
        self._root = store.storage.root if isinstance(store.storage, LocalStorage) else None
        self._reserve_bytes = reserve_bytes
        self._clock = clock
        self._refused_until = 0.0

    def note_refusal(self) -> None:
        """Record that the disk has just refused a write; it may do so with free space left, because of a quota."""
        self._refused_until = self._clock() + FULL_S

    def reason(self) -> str | None:
        """The reason why no job should be taken now, or None; raises StoreError if the store's folder is gone."""
        if self._clock() < self._refused_until:
            return "the disk is full; trying again now and then"
        if self._root is None:
            return None
        with store_errors("ask how much of the disk is free", self._root):
            free = shutil.disk_usage(self._root).free
        if free >= self._reserve_bytes:
            return None
        return (
            f"{free / 1e9:.1f} GB are free on the disk of {self._root}, and {self._reserve_bytes / 1e9:g} GB are to "
            "stay free (--reserve)"
        )


def is_full(error: BaseException) -> bool:
    """Whether an error means that there is no space, on the disk or in a quota."""
    cause = error.__cause__ or error
    return isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)


class TrainerPace:
    """Keeps a scene's committed samples ≤ ratio × those that its trainer has used, or AHEAD_MINIMUM if that is more.

    Each scene is treated by itself, as a trainer uses the samples of one scene.
    """

    def __init__(
        self,
        store: Store,
        connection: Redis,
        ratio: float,
        *,
        scene_id: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take the sources of both numbers. A ratio below 1 would stop all jobs, as no more is used than committed."""
        self._store, self._connection, self._ratio, self._scene_id = store, connection, ratio, scene_id
        self._clock = clock
        self._due = 0.0
        self._ahead: dict[str, str] = {}

    def scenes_ahead(self) -> dict[str, str]:
        """The scenes of which no job should be taken now: the reason, by scene id. Raises redis.RedisError."""
        if self._clock() >= self._due:
            began = self._clock()
            self._ahead = self._find_ahead()
            self._due = self._clock() + pause_after_look(self._clock() - began, AHEAD_LOOK_S)
        return self._ahead

    def _find_ahead(self) -> dict[str, str]:
        if self._scene_id is None:
            progress = self._store.each(_progress)[0]  # a scene that cannot be read holds back no jobs
        else:
            progress = {self._scene_id: _progress(self._store.scene(self._scene_id))}
        committed = {
            scene_id: scene.committed_samples
            for scene_id, scene in progress.items()
            if AHEAD_MINIMUM < scene.committed_samples < scene.planned_samples
        }
        used = read_consumed(self._connection, list(committed))
        return {
            scene_id: f"{samples} samples are committed, and the trainer has used {used[scene_id]} "
            f"(--ahead {self._ratio:g})"
            for scene_id, samples in committed.items()
            if samples > self._ratio * used[scene_id]
        }


def _progress(scene: SceneStore) -> Progress:
    return scene.progress(followed=True)
