"""All that we use of RQ, and the one module that imports it: its queue, jobs, executions, retries and failures.

Our workers replace RQ's: they call no function that Redis names, but render. A process keeps its scene loaded from job
to job, as RQ's SimpleWorker would, and gives signs of life during a job, as that does not.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain

from redis import Redis
from redis.client import Pipeline
from rq import Queue, Retry
from rq.exceptions import DeserializationError, NoSuchJobError
from rq.executions import Execution as Execution
from rq.job import Job
from rq.job_lifecycle import record_job_failure
from rq.results import Result
from rq.serializers import JSONSerializer

from photonfarm.queue.connection import redis_errors
from photonfarm.queue.failures import Failure, shorten
from photonfarm.queue.job import FUNCTION, QUEUE, QUEUE_KEY, TRIES, is_job_name, job_name, scene_of
from photonfarm.queue.workers import Activity, decode_text, read_started, read_workers

AT_ONCE = 500
"""The names of queued jobs in one request."""

log = logging.getLogger(__name__)


def open_queue(connection: Redis) -> Queue:
    """The queue, whose messages are JSON."""
    return Queue(QUEUE, connection=connection, serializer=JSONSerializer)


def add(queue: Queue, jobs: Iterable[tuple[str, int]]) -> None:
    """Add jobs, each a scene id and a number, at the end, to be tried `TRIES` times."""
    queue.enqueue_many(
        Queue.prepare_data(
            FUNCTION,
            kwargs={"scene_id": scene_id, "job": job},
            timeout=-1,  # the worker has a deadline of its own, also for native code
            result_ttl=0,  # nothing remains of a finished job: it has its marker
            failure_ttl=-1,
            description=f"{scene_id} job {job}",
            job_id=job_name(scene_id, job),
            retry=Retry(max=TRIES - 1),
        )
        for scene_id, job in jobs
    )


def take(
    queue: Queue, worker: str, *, ttl_s: int, scene_id: str | None = None, leave: Collection[str] = ()
) -> Execution | None:
    """Start the next job, and return its execution, which lasts for `ttl_s` unless it is kept alive; None without one.

    Jobs of other scenes than `scene_id`, and of the scenes in `leave`, stay in the queue for other workers. A job lost
    between the queue and its execution is queued again by `reconcile`.
    """
    pages = (queue.get_job_ids(first, AT_ONCE) for first in range(0, len(queue), AT_ONCE))
    for name in chain.from_iterable(pages):
        scene = scene_of(name)
        if scene in leave or scene_id not in (None, scene):
            continue
        if not queue.connection.lrem(queue.key, 1, name):  # another worker was faster
            continue
        if (job := _fetch_job(queue, name)) is None:
            continue
        with queue.connection.pipeline() as pipeline:
            execution = Execution.create(job, ttl_s, pipeline, worker)
            job.prepare_for_execution(worker, pipeline)
            pipeline.execute()
        return execution
    return None


def _fetch_job(queue: Queue, name: str) -> Job | None:
    """A job by its name; None if Redis has lost it, or it is not one of ours, which is logged."""
    try:
        job = Job.fetch(name, connection=queue.connection, serializer=JSONSerializer)
        if is_job_name(name) and job.func_name == FUNCTION:
            return job
    except NoSuchJobError:
        return None
    except DeserializationError:
        pass
    log.warning("the queue's entry %r is no job to render, and is thrown away", name)
    return None


def keep_alive(queue: Queue, execution: Execution, pipeline: Pipeline, ttl_s: int) -> None:
    """Write that an execution goes on; all of it, as Redis may have lost it."""
    execution.save(ttl_s, pipeline)
    queue.started_job_registry.add_execution(execution, pipeline, ttl=ttl_s)
    pipeline.sadd(execution.worker_executions_key, execution.composite_key)
    pipeline.expire(execution.worker_executions_key, ttl_s + 60)


def finish(queue: Queue, execution: Execution) -> None:
    """End an execution whose job is done, of which nothing remains."""
    with queue.connection.pipeline() as pipeline:
        execution.delete(_make_stub(queue, execution.job_id), pipeline)
        _forget(queue, execution.job_id, pipeline)
        pipeline.execute()


def fail(queue: Queue, execution: Execution, reason: str, *, counts: bool = True) -> bool:
    """End an execution whose job is not done: the job is queued again, at the end, or set aside after its last try.

    Unless the failure `counts`, the job has as many tries left as before. Returns whether this call has set it aside.
    Of several calls for one execution only the first has an effect; a job that Redis has lost is left to `reconcile`.
    """
    if not queue.connection.zrem(queue.started_job_registry.key, execution.composite_key):
        return False
    job, is_set_aside = _fetch_job(queue, execution.job_id), False
    with queue.connection.pipeline() as pipeline:
        execution.delete(job or _make_stub(queue, execution.job_id), pipeline)
        if job is not None:
            job.retries_left = (job.retries_left or 0) + (not counts)  # RQ takes one off at each retry
            if job.should_retry:
                job.retry(queue, pipeline)
            else:
                record_job_failure(job, shorten(reason), pipeline)
                is_set_aside = True
        pipeline.execute()
    return is_set_aside


def fail_lost(queue: Queue) -> None:
    """Fail the executions whose workers no longer keep them alive."""
    for entry, alive in read_started(queue.connection).items():
        if not alive:
            fail(queue, Execution.from_composite_key(entry, queue.connection), "its worker died, or lost Redis")


def fail_of_worker(connection: Redis, worker: str, reason: str, *, counts: bool) -> None:
    """Fail what a worker has in hand, whose process has ended."""
    of_worker = Execution("", "", connection, worker).worker_executions_key
    for entry in connection.smembers(of_worker):
        execution = Execution.from_composite_key(decode_text(entry), connection)
        execution.worker_name = worker
        fail(open_queue(connection), execution, reason, counts=counts)


def read_failures(queue: Queue) -> dict[str, Failure]:
    """The jobs that are set aside, by name."""
    names = [name for name in queue.failed_job_registry.get_job_ids(cleanup=False) if is_job_name(name)]
    with queue.connection.pipeline(transaction=False) as pipeline:
        for name in names:
            pipeline.xrevrange(Result.get_key(name), count=1)
        failures = {}
        for name, last in zip(names, pipeline.execute(), strict=True):
            result = Result.restore(name, last[0][0].decode(), last[0][1], queue.connection) if last else None
            failures[name] = Failure(str(result.exc_string) if result else "unknown", TRIES)
    return failures


def forget_failures(queue: Queue, scene_id: str = "") -> None:
    """Forget the jobs that are set aside, or those of one scene: they are queued again as if they were new."""
    with queue.connection.pipeline() as pipeline:
        for name in queue.failed_job_registry.get_job_ids(cleanup=False):
            if name.startswith(scene_id):
                _forget(queue, name, pipeline)
        pipeline.execute()


def _forget(queue: Queue, name: str, pipeline: Pipeline) -> None:
    """Remove a job with its results, and from those that are set aside."""
    pipeline.zrem(queue.failed_job_registry.key, name)
    pipeline.delete(Job.key_for(name), Result.get_key(name))


def _make_stub(queue: Queue, name: str) -> Job:
    """A job that is a name alone, which is all that ending an execution needs: Redis may have lost the rest."""
    job = Job(name, connection=queue.connection, serializer=JSONSerializer)
    job.origin = QUEUE
    return job


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """The queue and the workers, as Redis has them."""

    queued: int
    running: int  # jobs whose workers are alive
    workers: int  # alive; those of this machine only if their process is
    failed: dict[str, Failure]  # those set aside, by job name
    paused: Mapping[str, str] = field(default_factory=dict)  # by worker: why it takes no jobs
    skipped: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # by scene id and worker: why it skips it
    activities: Mapping[str, Activity] = field(default_factory=dict)  # by worker


def queue_status(connection: Redis) -> QueueStatus:
    """Jobs queued, running and failed, and workers; raises QueueError if Redis fails."""
    with redis_errors("asked for its status"):
        workers = read_workers(connection)
        skipped: dict[str, dict[str, str]] = {}
        for name, report in workers.items():
            for scene_id, reason in report.left.items():
                skipped.setdefault(scene_id, {})[name] = reason
        return QueueStatus(
            queued=connection.llen(QUEUE_KEY),
            running=sum(read_started(connection).values()),
            workers=len(workers),
            failed=read_failures(open_queue(connection)),
            paused={name: report.paused for name, report in workers.items() if report.paused},
            skipped=skipped,
            activities={name: report.doing for name, report in workers.items() if report.doing},
        )
