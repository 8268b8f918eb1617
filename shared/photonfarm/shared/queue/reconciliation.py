"""Filling the queue from the store, which knows what is missing; there is no coordinator, whoever is idle does it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import redis
from redis import Redis
from rq import Queue
from rq.worker_registration import clean_worker_registry

from photonfarm.shared.errors import QueueError
from photonfarm.shared.queue.failures import Failure, failed_names, forget_failures, read_failures
from photonfarm.shared.queue.heartbeat import ALIVE, WORKER, names_below
from photonfarm.shared.queue.job import (
    FAILURE_TTL_S,
    FUNCTION,
    RQ_TIMEOUT_S,
    RenderQueue,
    job_name,
    open_queue,
    queued_names,
    running_names,
)
from photonfarm.shared.store import SceneStore, Store

QUEUE_LIMIT = 10_000
"""Jobs queued at most, at 1.9 kB of Redis memory each; the store holds the rest."""

LOCK_TTL_S = 120
_LOCK = "rq:photonfarm:reconcile"


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
    """Queue every job that is planned, not committed, not queued, not alive and not failed; how many that were.

    Of one scene, or of all. One caller at a time: 0 if another one is at it for longer than `wait_s`. At most `limit`
    jobs are queued in all; the rest follows later. `retry_failed` forgets failures first, and `retry_set_aside` also
    those of jobs that failed too often. Raises QueueError if Redis fails, StoreError if the scene is not there.
    """
    try:
        lock = connection.lock(_LOCK, timeout=LOCK_TTL_S)
        if not lock.acquire(blocking=wait_s > 0, blocking_timeout=wait_s):
            return 0
        try:
            if retry_failed or retry_set_aside:
                forget_failures(connection, set_aside=retry_set_aside)
            return _reconcile(store.scenes(scene_id), connection, limit)
        finally:
            if lock.owned():
                lock.release()
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while the queue was filled: {error}") from error


def _reconcile(scenes: Iterable[SceneStore], connection: Redis, limit: int) -> int:
    queue = open_queue(connection)
    queued = set(queued_names(queue))
    alive = names_below(connection, ALIVE)
    _tidy(queue, alive)
    busy = queued | alive | failed_names(connection)
    missing = (
        (scene.scene_id, job)
        for scene in scenes
        for job in scene.missing_jobs()
        if job_name(scene.scene_id, job) not in busy
    )
    wanted = list(islice(missing, max(limit - len(queued), 0)))
    _enqueue(queue, wanted)
    return len(wanted)


def _enqueue(queue: RenderQueue, jobs: Iterable[tuple[str, int]]) -> None:
    data = [
        Queue.prepare_data(
            FUNCTION,
            kwargs={"scene_id": scene_id, "job": job},
            timeout=RQ_TIMEOUT_S,
            result_ttl=0,  # a finished job leaves nothing: the marker tells it
            failure_ttl=FAILURE_TTL_S,
            description=f"{scene_id} job {job}",
            job_id=job_name(scene_id, job),
        )
        for scene_id, job in jobs
    ]
    if data:
        queue.enqueue_many(data)


def _tidy(queue: RenderQueue, alive: set[str]) -> None:
    """Take what dead workers left out of RQ's registries, which would otherwise be watched as if it were running."""
    stale = [entry for entry in running_names(queue) if entry.split(":")[0] not in alive]
    if stale:
        queue.connection.zrem(queue.started_job_registry.key, *stale)
    for name in set(queued_names(queue, queue.intermediate_queue_key)) - alive:
        queue.connection.lrem(queue.intermediate_queue_key, 0, name)
    queue.failed_job_registry.cleanup()
    clean_worker_registry(queue)


# ------------------------------------------------------------------------------------------------------------- status


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """What Redis knows."""

    queued: int
    running: int  # jobs with a heartbeat
    workers: int  # with a heartbeat
    failed: dict[str, Failure]  # by job name


def queue_status(connection: Redis) -> QueueStatus:
    """Jobs queued, running and failed, and workers; raises QueueError if Redis fails."""
    try:
        return QueueStatus(
            queued=len(open_queue(connection)),
            running=len(names_below(connection, ALIVE)),
            workers=len(names_below(connection, WORKER)),
            failed=read_failures(connection),
        )
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while it was asked for its status: {error}") from error
