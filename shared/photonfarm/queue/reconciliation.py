"""Fills the queue from the store, which knows what is missing; any idle worker does it, without a coordinator."""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from itertools import islice
from typing import Literal, NamedTuple

from redis import Redis
from redis.exceptions import LockError

from photonfarm.core.errors import QueueError
from photonfarm.queue.connection import redis_errors
from photonfarm.queue.job import job_name, scene_of
from photonfarm.queue.rq_adapter import add, fail_lost, forget_failures, open_queue
from photonfarm.queue.workers import read_started, serve
from photonfarm.store import SceneStore, Store

QUEUE_LIMIT = 10_000
"""The most jobs of a scene in the queue, at 1.9 kB of Redis memory each; the store holds the rest."""

LOCK_S = 10
"""How long one process at most fills the queue alone, and how long a killed one holds the others up. If it takes
longer, another one may queue a job twice, and the first commit stays."""

LOOKED = "rq:photonfarm:looked:"

Look = Literal["queued", "waits", "nothing"]
"""What a look at the store found: jobs, which are queued now; jobs that others will end; or none to wait for.

Others will end what is queued or being rendered; and whatever another process may find that looks right now.
"""

log = logging.getLogger(__name__)

_logged: dict[str, str] = {}
"""Why scenes were skipped, by scene id: an idle worker looks every few seconds, and logs each reason once."""


def fill_seldom(store: Store, connection: Redis, *, scene_id: str | None = None, every_s: float) -> Look:
    """Fill the queue as `reconcile` does, at most once in `every_s` by all callers together.

    So a thousand workers that wait for the last jobs cost the store and Redis no more than one of them. The others
    learn what the last look found. After "nothing" a caller may look for itself whether it can end. Raises what
    `reconcile` does.
    """
    key = f"{LOOKED}{scene_id or 'all'}"
    with redis_errors("asked what is missing"):
        if known := connection.get(key):
            return "waits" if known == b"waits" else "nothing"
        filled = _fill_alone(store, connection, scene_id)
        if filled is None:
            return "waits"
        if filled.queued:
            return "queued"  # not kept for the others, as all of that may soon be taken
        look: Look = "waits" if filled.under_way else "nothing"
        connection.set(key, look, px=int(1000 * every_s))
        return look


def reconcile(
    store: Store, connection: Redis, *, scene_id: str | None = None, wait_s: float = 10.0, retry: bool | str = False
) -> int:
    """Queue every job that is planned, not committed, not queued, not started and not failed; returns how many.

    It works on one scene, or on all, and for one caller at a time: while another one is at it, this one waits for
    `wait_s`, and then raises QueueError. Of a scene at most QUEUE_LIMIT jobs are queued; the rest follows later. With
    `retry` the jobs that failed too often are forgotten first, or those of the scene with that id. A scene that cannot
    be read is skipped with a warning.
    Raises QueueError also if Redis fails or serves another store, StoreError if the store or the one scene cannot be
    read.
    """
    filled = _fill_alone(store, connection, scene_id, wait_s, retry=retry)
    if filled is None:
        raise QueueError(
            f"another process has been filling the queue for {wait_s:g} s, so this one has queued and retried "
            "nothing; try again"
        )
    return filled.queued


class _Filled(NamedTuple):
    queued: int  # jobs, just now
    under_way: int  # missing jobs that were queued or started before


def _fill_alone(
    store: Store, connection: Redis, scene_id: str | None, wait_s: float = 0.0, *, retry: bool | str = False
) -> _Filled | None:
    """What `reconcile` has done; None if another process still fills the queue after `wait_s`. Raises as that does."""
    serve(connection, store)
    with redis_errors("filled with what is missing"):
        lock = connection.lock("rq:photonfarm:reconcile", timeout=LOCK_S)
        if not lock.acquire(blocking=wait_s > 0, blocking_timeout=wait_s):
            return None
        try:
            if retry:
                forget_failures(open_queue(connection), retry if isinstance(retry, str) else "")
            return _fill(store, connection, scene_id)
        finally:
            with contextlib.suppress(LockError):  # it took longer than the lock lasts
                lock.release()


def _fill(store: Store, connection: Redis, only: str | None) -> _Filled:
    queue = open_queue(connection)
    fail_lost(queue)
    queued = queue.get_job_ids()
    started = [entry.partition(":")[0] for entry in read_started(connection)]  # from `<name>:<execution>`
    under_way = {*queued, *started}
    busy = under_way.union(queue.failed_job_registry.get_job_ids(cleanup=False))
    queued_of = Counter(map(scene_of, queued))
    missing = _missing(store, only)  # after the rest: what has left the queue since is committed
    wanted = [
        (scene_id, job)
        for scene_id, jobs in missing.items()
        for job in islice(
            (job for job in jobs if job_name(scene_id, job) not in busy),
            max(QUEUE_LIMIT - queued_of[scene_id], 0),
        )
    ]
    add(queue, wanted)
    names = (job_name(scene_id, job) for scene_id, jobs in missing.items() for job in jobs)
    return _Filled(len(wanted), sum(name in under_way for name in names))


def _missing(store: Store, only: str | None) -> dict[str, list[int]]:
    """The missing jobs of every scene that can be read; or of one scene, whose error is raised."""
    if only is not None:
        return {only: store.scene(only).missing_jobs()}
    missing, failed = store.each(SceneStore.missing_jobs)
    for scene_id, error in failed.items():
        if _logged.get(scene_id) != str(error):
            log.warning("scene %s is passed over, and the others go on: %s", scene_id, error)
        _logged[scene_id] = str(error)
    return missing
