"""The queue: RQ, which may run one function of ours and nothing else, and `reconcile`, which fills it from the store.

Redis is disposable: every job in it can be derived again from plans and markers. Keys of ours, beside RQ's:

    alive:<job name>                    heartbeat of a job being rendered; the value is the worker's name
    rq:photonfarm:failed:<job name>     why a job failed; it is not queued again while this lasts
    rq:photonfarm:starts:<job name>     how often a job was started without an end
    rq:photonfarm:worker:<worker name>  heartbeat of a worker; the value is its host and the job it renders, or -
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Annotated, Any

import redis
from pydantic import Field, ValidationError
from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry
from rq import Queue
from rq.job import Job
from rq.serializers import JSONSerializer
from rq.utils import as_text, import_attribute
from rq.worker_registration import clean_worker_registry

from photonfarm.shared.errors import IncompleteError, QueueError
from photonfarm.shared.scene import Frozen, sentences
from photonfarm.shared.store import SceneStore, Store

QUEUE = "photonfarm"
FUNCTION = "photonfarm.renderer.jobs.render_shard"
"""The one function that a job may name; a string, since whoever submits needs no renderer."""

QUEUE_LIMIT = 10_000
"""Jobs queued at most, at 1.9 kB of Redis memory each; the store holds the rest."""

FAILURE_TTL_S = 3600
"""A failed job is left alone for an hour: long enough not to burn cores on it, short enough to heal by itself."""

RQ_TIMEOUT_S = 7 * 86400
"""RQ's own time limit cannot interrupt native code, so it is out of the way; the worker's deadline counts."""

LOCK_TTL_S = 120
SOCKET_TIMEOUT_S = 30

FAILED = "rq:photonfarm:failed:"
STARTS = "rq:photonfarm:starts:"
WORKER = "rq:photonfarm:worker:"
ALIVE = "alive:"
_LOCK = "rq:photonfarm:reconcile"


def connect(url: str) -> Redis:
    """A connection that has answered once; raises QueueError with a sentence if there is no Redis or it refuses us."""
    try:
        connection = Redis.from_url(url, socket_timeout=SOCKET_TIMEOUT_S, socket_connect_timeout=5, retry=_retry())
        connection.ping()
    except (redis.RedisError, ValueError, OSError) as error:
        raise QueueError(f"no Redis at {_without_password(url)}: {error}") from error
    return connection


def _retry() -> Retry:
    """Three tries within a second, against hiccups; longer outages are the supervisor's to wait out."""
    return Retry(ExponentialBackoff(cap=0.5, base=0.1), 3)


def _without_password(url: str) -> str:
    scheme, separator, rest = url.partition("://")
    return f"{scheme}{separator}{rest.rpartition('@')[2]}"


def job_name(scene_id: str, job: int) -> str:
    """The name of a job in the queue; RQ allows letters, digits, - and _."""
    return f"{scene_id}-{job}"


class RenderArguments(Frozen):
    """What a job's arguments may be."""

    scene_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", strict=True)]
    job: Annotated[int, Field(ge=0, lt=1 << 48, strict=True)]


class RenderJob(Job):
    """A job that can only be ours.

    RQ imports and calls any dotted name that stands in Redis, also for callbacks, and with JSON as well. Here one
    function is known and everything else is refused, whoever wrote it.
    """

    _refusal: str | None = None

    def refuse(self, reason: str) -> None:
        """Make the job fail for a reason instead of running."""
        self._refusal = reason

    def restore(self, raw_data: Any) -> None:
        """Read the job as Redis holds it, without anything that RQ would call by itself."""
        super().restore(raw_data)
        self._success_callback_name = self._failure_callback_name = self._stopped_callback_name = None
        self.webhooks.clear()
        self.repeats_left = self.retries_left = None

    @property
    def func(self) -> Any:
        """The one function; raises QueueError for any other, IncompleteError for a job that was refused."""
        self.arguments()
        if self._refusal:
            raise IncompleteError(f"job {self.id} is not run: {self._refusal}")
        return import_attribute(FUNCTION)

    def arguments(self) -> RenderArguments:
        """The checked arguments; raises QueueError with the reason for a job that is not ours."""
        if self.func_name != FUNCTION or self.instance is not None:
            raise QueueError(f"job {self.id}: function {self.func_name!r} is refused; only {FUNCTION} may be run")
        if self.args or not isinstance(self.kwargs, dict):
            raise QueueError(f"job {self.id}: arguments must be given by name")
        try:
            arguments = RenderArguments.model_validate(self.kwargs)
        except ValidationError as error:
            raise QueueError(f"job {self.id}: {'; '.join(sentences(error))}") from error
        if self.id != job_name(arguments.scene_id, arguments.job):
            raise QueueError(f"job {self.id}: is named for another job than its arguments tell")
        return arguments


def open_queue(connection: Redis) -> Queue:
    """The queue. A worker listens to this one alone: on several, RQ would lose a job with the worker that took it."""
    return Queue(QUEUE, connection=connection, job_class=RenderJob, serializer=JSONSerializer)


# ---------------------------------------------------------------------------------------------------------- reconcile


def reconcile(
    store: Store,
    connection: Redis,
    *,
    scene_id: str | None = None,
    limit: int = QUEUE_LIMIT,
    wait_s: float = 10.0,
    retry_failed: bool = False,
) -> int:
    """Queue every job that is planned, not committed, not queued, not alive and not failed; how many that were.

    Of one scene, or of all. One caller at a time: 0 if another one is at it for longer than `wait_s`. At most `limit`
    jobs are queued in all; the rest follows later. `retry_failed` forgets failures first.
    Raises QueueError if Redis fails, StoreError if the scene is not there.
    """
    try:
        lock = connection.lock(_LOCK, timeout=LOCK_TTL_S)
        if not lock.acquire(blocking=wait_s > 0, blocking_timeout=wait_s):
            return 0
        try:
            return _reconcile(store.scenes(scene_id), connection, limit, retry_failed)
        finally:
            if lock.owned():
                lock.release()
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while the queue was filled: {error}") from error


def _reconcile(scenes: Iterable[SceneStore], connection: Redis, limit: int, retry_failed: bool) -> int:
    queue = open_queue(connection)
    if retry_failed:
        _forget_failures(connection)
    queued = set(queue.get_job_ids())
    alive, failed = _names(connection, ALIVE), _names(connection, FAILED)
    _tidy(queue, alive)
    busy = queued | alive | failed
    missing = (
        (scene.scene_id, job)
        for scene in scenes
        for job in scene.missing_jobs()
        if job_name(scene.scene_id, job) not in busy
    )
    wanted = list(islice(missing, max(limit - len(queued), 0)))
    _enqueue(queue, wanted)
    return len(wanted)


def _forget_failures(connection: Redis) -> None:
    for prefix in (FAILED, STARTS):
        for key in list(connection.scan_iter(f"{prefix}*", count=1000)):
            connection.delete(key)


def _names(connection: Redis, prefix: str) -> set[str]:
    return {as_text(key).removeprefix(prefix) for key in connection.scan_iter(f"{prefix}*", count=1000)}


def _enqueue(queue: Queue, jobs: Iterable[tuple[str, int]]) -> None:
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


def _tidy(queue: Queue, alive: set[str]) -> None:
    """Take what dead workers left out of RQ's registries, which would otherwise be watched as if it were running."""
    running = queue.started_job_registry.key
    stale = [
        entry for entry in map(as_text, queue.connection.zrange(running, 0, -1)) if entry.split(":")[0] not in alive
    ]
    if stale:
        queue.connection.zrem(running, *stale)
    for name in set(map(as_text, queue.connection.lrange(queue.intermediate_queue_key, 0, -1))) - alive:
        queue.connection.lrem(queue.intermediate_queue_key, 0, name)
    queue.failed_job_registry.cleanup()
    clean_worker_registry(queue)


# ------------------------------------------------------------------------------------------------------------- status


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """What Redis knows."""

    queued: int
    running: int  # jobs with a heartbeat
    failed: dict[str, str]  # why, by job name
    workers: int  # with a heartbeat


def queue_status(connection: Redis) -> QueueStatus:
    """Jobs queued, running and failed, and workers; raises QueueError if Redis fails."""
    try:
        queue = open_queue(connection)
        failed = sorted(_names(connection, FAILED))
        reasons = connection.mget([FAILED + name for name in failed]) if failed else []
        return QueueStatus(
            queued=len(queue),
            running=len(_names(connection, ALIVE)),
            failed={name: as_text(reason) for name, reason in zip(failed, reasons, strict=True) if reason},
            workers=len(_names(connection, WORKER)),
        )
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while it was asked for its status: {error}") from error


def record_failure(connection: Redis, name: str, reason: str) -> None:
    """Leave a job alone for a while, and say why."""
    connection.set(FAILED + name, reason, ex=FAILURE_TTL_S)


# --------------------------------------------------------------------------------------------------------- heartbeats


def beat(connection: Redis, worker: str, host: str, name: str | None, *, ttl_s: float) -> None:
    """Say for a time that a worker is alive, and the job that it renders, if any."""
    ttl_ms = int(ttl_s * 1000)  # the server's clock counts it down, not a client's
    with connection.pipeline() as pipeline:
        pipeline.set(WORKER + worker, f"{host} {name or '-'}", px=ttl_ms)
        if name:
            pipeline.set(ALIVE + name, worker, px=ttl_ms)
        pipeline.execute()


def bury(connection: Redis, worker: str) -> None:
    """Free at once the job that a worker of this name died with, instead of when its heartbeat runs out."""
    last = connection.getdel(WORKER + worker)
    if last is not None:
        connection.delete(ALIVE + as_text(last).split()[-1])


def hosts(connection: Redis) -> set[str]:
    """The hosts that have a worker alive."""
    keys = [WORKER + name for name in _names(connection, WORKER)]
    return {as_text(value).split()[0] for value in (connection.mget(keys) if keys else []) if value}
