"""Fills the queue from the store, which knows what is missing; any idle worker does it, without a coordinator."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import redis
from redis import Redis

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.core.processes import repeating
from photonfarm.shared.queue.entries import queued_names, running_names, taken_names
from photonfarm.shared.queue.failures import FAILURES, failed_names, forget_failures
from photonfarm.shared.queue.heartbeat import ALIVE, HEARTBEAT_MOST_S
from photonfarm.shared.queue.job import OVERDUE, STARTS, job_name
from photonfarm.shared.queue.rq_adapter import (
    EXECUTIONS,
    JOB,
    RESULTS,
    WORKERS,
    WORKERS_OF_QUEUE,
    RenderQueue,
    open_queue,
)
from photonfarm.shared.queue.served_store import serve
from photonfarm.shared.queue.untrusted import (
    Kind,
    beginnings,
    forget_dead_workers,
    names_below,
    remove_lasting,
    remove_others,
)
from photonfarm.shared.store import SceneStore, Store

QUEUE_LIMIT = 10_000
"""The most jobs in the queue, at 1.9 kB of Redis memory each; the store holds the rest."""

LOCK_TTL_S = 10
"""How long the lock outlasts a process that died while it filled the queue; a live one renews it."""

LOOKED_MOST_S = 60
"""The longest that the result of a look may last; a key that lasts longer is a stranger's."""

_LOCK = "rq:photonfarm:reconcile"
LOOKED = "rq:photonfarm:looked:"

Look = Literal["queued", "waits", "nothing"]
"""What a look at the store found: jobs, which are queued now; jobs that others will end; or none to wait for.

Others will end what is queued or being rendered; and whatever another process may find that looks right now.
"""

log = logging.getLogger(__name__)

_logged: dict[str, str] = {}
"""Why scenes were skipped, by scene id: an idle worker looks every few seconds, and logs each reason once."""

_KINDS: dict[str, Kind] = {
    JOB: "hash",
    EXECUTIONS: "zset",
    RESULTS: "stream",
    STARTS: "counter",
    OVERDUE: "counter",
    FAILURES: "counter",
}
"""The types of the keys that are written for a job, by the prefix before its name."""


def look(store: Store, connection: Redis, *, scene_id: str | None = None, every_s: float) -> Look:
    """Fill the queue as `reconcile` does, at most once in `every_s` by all callers together.

    So a thousand workers that wait for the last jobs cost the store and Redis no more than one of them. The others
    learn what the last look found. After "nothing" a caller may look for itself whether it can end. Raises what
    `reconcile` does.
    """
    key = f"{LOOKED}{scene_id or 'all'}"
    try:
        if (known := _found_lately(connection, key)) is not None:
            return known
        found = _filled(store, connection, scene_id=scene_id)
        if found is None:
            return "waits"
        if found.queued:
            return "queued"
        outcome: Look = "waits" if found.under_way else "nothing"
        connection.set(key, outcome, px=int(1000 * min(every_s, LOOKED_MOST_S)))
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while it was asked what is missing: {error}") from error
    return outcome


def _found_lately(connection: Redis, key: str) -> Look | None:
    """What another caller's look has found, so recently that it still counts."""
    remove_lasting(connection, [key], LOOKED_MOST_S)
    (known,) = beginnings(connection, [key], 16)
    return "waits" if known == "waits" else "nothing" if known == "nothing" else None


def reconcile(
    store: Store,
    connection: Redis,
    *,
    scene_id: str | None = None,
    limit: int = QUEUE_LIMIT,
    wait_s: float = 10.0,
    retry_failed: bool = False,
    retry_set_aside: bool = False,
) -> int:
    """Queue every job that is planned, not committed, not queued, not alive and not failed; returns how many.

    It works on one scene, or on all, and for one caller at a time: while another one is at it, this one waits for
    `wait_s`, and then raises QueueError; a caller who does not wait at all gets 0. At most `limit` jobs are queued in
    all; the rest follows later. Scenes share these places equally, as a scene whose jobs no worker takes would block
    the others: the jobs beyond a scene's share leave the queue when another scene needs their places. `retry_failed`
    forgets failures first, and `retry_set_aside` also those of jobs that failed too often. A scene that
    cannot be read is skipped with a warning. Raises QueueError also if Redis fails or serves another store, StoreError
    if the store or the one scene cannot be read.
    """
    found = _filled(
        store,
        connection,
        scene_id=scene_id,
        limit=limit,
        wait_s=wait_s,
        retry_failed=retry_failed,
        retry_set_aside=retry_set_aside,
    )
    if found is None and wait_s > 0:
        raise QueueError(
            f"another process has been filling the queue for {wait_s:g} s, so this one has queued and retried "
            "nothing; try again"
        )
    return found.queued if found else 0


@dataclass(frozen=True, slots=True)
class Filled:
    """What a reconciliation found."""

    queued: int  # jobs that it has queued
    under_way: int  # missing jobs that were queued or alive


def _filled(
    store: Store,
    connection: Redis,
    *,
    scene_id: str | None,
    limit: int = QUEUE_LIMIT,
    wait_s: float = 0.0,
    retry_failed: bool = False,
    retry_set_aside: bool = False,
) -> Filled | None:
    """What `reconcile` has done; None if another process still fills the queue after `wait_s`. Raises as that does."""
    serve(connection, store)
    try:
        with _alone(connection, wait_s) as alone:
            if not alone:
                return None
            if retry_failed or retry_set_aside:
                forget_failures(connection, set_aside=retry_set_aside)
            return _reconcile(store, scene_id, connection, limit)
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while the queue was filled: {error}") from error


@contextlib.contextmanager
def _alone(connection: Redis, wait_s: float) -> Iterator[bool]:
    """Hold the lock until the block ends; yields False if another process still holds it after `wait_s`."""
    remove_lasting(connection, [_LOCK], LOCK_TTL_S)  # our own expires by then
    lock = connection.lock(_LOCK, timeout=LOCK_TTL_S, thread_local=False)
    if not lock.acquire(blocking=wait_s > 0, blocking_timeout=wait_s):
        yield False
        return

    def renew() -> None:
        with contextlib.suppress(redis.RedisError):
            lock.reacquire()

    try:
        with repeating(LOCK_TTL_S / 4, renew):
            yield True
    finally:
        if lock.owned():
            lock.release()


def _reconcile(store: Store, only: str | None, connection: Redis, limit: int) -> Filled:
    queue = open_queue(connection)
    queued = list(dict.fromkeys(queued_names(queue)))
    remove_lasting(connection, [ALIVE + name for name in names_below(connection, ALIVE)], HEARTBEAT_MOST_S)
    alive = names_below(connection, ALIVE)
    _tidy(queue, alive)
    under_way = {*queued, *alive}
    busy = under_way | failed_names(connection)
    held = _by_scene(queued)
    missing = _missing_by_scene(store, only)
    lacking = {scene_id: _lacking(scene_id, jobs, busy, limit) for scene_id, jobs in missing.items()}
    has = {scene_id: len(held.get(scene_id, ())) for scene_id in {**held, **lacking}}
    shares = _shares({scene_id: count + len(lacking.get(scene_id, ())) for scene_id, count in has.items()}, limit)
    wanted = [
        (scene_id, job)
        for scene_id, jobs in lacking.items()
        for job in jobs[: max(shares[scene_id] - has[scene_id], 0)]
    ]
    if wanted:
        beyond = [name for scene_id, names in held.items() for name in names[shares[scene_id] :]]
        queue.withdraw(beyond[: max(len(queued) + len(wanted) - limit, 0)])  # they stay in the store
        _enqueue(queue, wanted)
    names = (job_name(scene_id, job) for scene_id, jobs in missing.items() for job in jobs)
    return Filled(len(wanted), 0 if wanted else sum(name in under_way for name in names))


def _missing_by_scene(store: Store, only: str | None) -> dict[str, list[int]]:
    """The missing jobs of every scene that can be read; or of one scene, whose error is raised."""
    if only is not None:
        return {only: store.scene(only).missing_jobs()}
    missing, failed = store.each(SceneStore.missing_jobs)
    for scene_id, error in failed.items():
        if _logged.get(scene_id) != str(error):
            log.warning("scene %s is passed over, and the others go on: %s", scene_id, error)
        _logged[scene_id] = str(error)
    return missing


def _lacking(scene_id: str, missing: Iterable[int], busy: Set[str], limit: int) -> list[int]:
    """The first missing jobs of a scene that are not in `busy`, at most `limit`."""
    return list(islice((job for job in missing if job_name(scene_id, job) not in busy), limit))


def _by_scene(names: Iterable[str]) -> dict[str, list[str]]:
    """Names grouped by the scene id that they begin with, in order."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(name.rpartition("-")[0], []).append(name)
    return found


def _shares(demand: Mapping[str, int], limit: int) -> dict[str, int]:
    """The number of places for each scene: its demand, or an equal share if the demands exceed the limit."""
    shares = {}
    for done, scene_id in enumerate(sorted(demand, key=lambda scene_id: demand[scene_id])):
        shares[scene_id] = min(demand[scene_id], limit // (len(demand) - done))
        limit -= shares[scene_id]
    return shares


def _enqueue(queue: RenderQueue, jobs: Sequence[tuple[str, int]]) -> None:
    names = [job_name(scene_id, job) for scene_id, job in jobs]
    remove_others(queue.connection, {before + name: kind for name in names for before, kind in _KINDS.items()})
    queue.add(jobs)


def _tidy(queue: RenderQueue, alive: set[str]) -> None:
    """Remove the entries of dead workers from RQ's registries, which would otherwise count as running."""
    stale = [entry for entry in running_names(queue) if _text(entry).split(":")[0] not in alive]
    if stale:
        queue.connection.zrem(queue.started_job_registry.key, *stale)
    for name in taken_names(queue):
        if _text(name) not in alive:
            queue.connection.lrem(queue.intermediate_queue_key, 0, name)
    queue.failed_job_registry.cleanup()
    forget_dead_workers(queue.connection, WORKERS_OF_QUEUE, WORKERS)


def _text(name: bytes) -> str:
    return name.decode(errors="replace")
