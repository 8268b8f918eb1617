"""All that we use of RQ, and the one module that imports it: its queue, its jobs, its worker, the names of its keys.

RQ imports and calls any dotted name that stands in Redis, also for callbacks and with JSON as well as pickle, and
sends webhooks anywhere. So a job here is its name (`job`). The rest of a job in Redis is JSON for RQ's own tools and is
never read here: no function, arguments, callbacks, time limits or dependents; so its size does not matter.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import redis
from redis import Redis
from rq import Queue, SimpleWorker
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer
from rq.utils import import_attribute, now
from rq.worker.base import StopRequested, WorkerStatus
from rq.worker_registration import REDIS_WORKER_KEYS, WORKERS_BY_QUEUE_KEY

from photonfarm.shared.core.errors import IncompleteError
from photonfarm.shared.queue.job import FAILURE_TTL_S, FUNCTION, QUEUE, RenderArguments, job_name
from photonfarm.shared.queue.untrusted import remove_others

RQ_TIMEOUT_S = 7 * 86400
"""RQ's own time limit cannot interrupt native code, so it is too long to matter; the worker has its own deadline."""

RQ_WORKER_TTL_S = 120
"""The seconds, and one minute more, after which RQ forgets a worker killed while idle; our own heartbeat decides."""

WORKERS = REDIS_WORKER_KEYS
WORKERS_OF_QUEUE = WORKERS_BY_QUEUE_KEY % QUEUE
"""RQ's registries of all workers, and of those of our queue."""

JOB, EXECUTIONS, RESULTS = "rq:job:", "rq:executions:", "rq:results:"
"""What stands before a job's name in the keys that RQ writes for it: a hash, a sorted set, a stream."""


class RenderJob(Job):
    """A job that can only render, whatever Redis holds of it."""

    _refusal: str | None = None

    def refuse(self, reason: str) -> None:
        """Make the job fail for a reason instead of running."""
        self._refusal = reason

    def refresh(self) -> None:
        """Set up the job from its name, without reading Redis; raises QueueError for an invalid name."""
        self.restore({})

    def restore(self, raw_data: Any) -> None:  # noqa: ARG002
        """Set up the job from its name; what Redis holds of it is ignored."""
        self.func_name = FUNCTION
        self.instance, self.args, self.kwargs = None, (), RenderArguments.of(self.id).model_dump()
        self.origin, self.description = QUEUE, self.id
        self.timeout, self.result_ttl, self.failure_ttl = RQ_TIMEOUT_S, 0, FAILURE_TTL_S
        self.created_at = self.enqueued_at = now()
        self._status = JobStatus.QUEUED

    def get_status(self, refresh: bool = True) -> JobStatus:  # noqa: ARG002
        """The status that this worker set, even if Redis has lost it."""
        return self._status

    @property
    def func(self) -> Any:
        """The one function; raises IncompleteError for a refused job."""
        if self._refusal:
            raise IncompleteError(f"job {self.id} is not run: {self._refusal}")
        return import_attribute(FUNCTION)


class RenderQueue(Queue):
    """RQ's queue, whose jobs have no dependents, even if a client wrote some into Redis."""

    job_class = RenderJob

    def enqueue_dependents(self, *args: Any, **options: Any) -> None:
        """Do nothing."""

    def job_named(self, name: str) -> RenderJob:
        """The job of a name; raises QueueError for an invalid name."""
        return RenderJob.fetch(name, connection=self.connection, serializer=JSONSerializer)

    def add(self, jobs: Iterable[tuple[str, int]]) -> None:
        """Add jobs, each a scene id and a number, at the end."""
        data = [
            Queue.prepare_data(
                FUNCTION,
                kwargs={"scene_id": scene_id, "job": job},
                timeout=RQ_TIMEOUT_S,
                result_ttl=0,  # nothing remains of a finished job: it has its marker
                failure_ttl=FAILURE_TTL_S,
                description=f"{scene_id} job {job}",
                job_id=job_name(scene_id, job),
            )
            for scene_id, job in jobs
        ]
        self.enqueue_many(data)

    def withdraw(self, names: Iterable[str]) -> None:
        """Remove jobs by name: the last entry of each name, and RQ's record of it."""
        with self.connection.pipeline(transaction=False) as pipeline:
            for name in names:
                pipeline.lrem(self.key, -1, name)
                pipeline.unlink(Job.key_for(name))
            pipeline.execute()


def open_queue(connection: Redis) -> RenderQueue:
    """The queue. A worker listens to this one alone: on several, RQ would lose a job with the worker that took it.

    Keys of the queue and of RQ's registries that hold another type are removed first. Raises RedisError.
    """
    queue = RenderQueue(QUEUE, connection=connection, job_class=RenderJob, serializer=JSONSerializer)
    remove_others(
        connection,
        {
            queue.key: "list",
            queue.intermediate_queue_key: "list",
            queue.started_job_registry.key: "zset",
            queue.failed_job_registry.key: "zset",
            queue.redis_queues_keys: "set",
            WORKERS: "set",
            WORKERS_OF_QUEUE: "set",
        },
    )
    return queue


class QueueWorker(SimpleWorker, ABC):
    """RQ's in-process worker, on our queue and with our jobs alone. Its abstract methods are hooks.

    It leaves out what RQ has too much of: commands over pub/sub, scheduled jobs, maintenance that loads strangers'
    jobs.
    """

    def __init__(self, connection: Redis, name: str, *, job_ttl_s: int) -> None:
        """Prepare without registering; `job_ttl_s` is how long RQ's own records of a running job last."""
        self._queue = open_queue(connection)
        self._job_ttl_s = job_ttl_s
        super().__init__(
            [self._queue],
            name=name,
            connection=connection,
            job_class=RenderJob,
            serializer=JSONSerializer,
            log_job_description=False,
            worker_ttl=RQ_WORKER_TTL_S,
        )

    # ----------------------------------------------------------------------------------------------------------- hooks

    @abstractmethod
    def next_job(self) -> RenderJob | None:
        """Take the next job; None if there was none for a while, or none should be taken."""

    @abstractmethod
    def on_idle(self) -> int | None:
        """Use the time without a job; an exit code ends the worker."""

    @abstractmethod
    def on_job(self, job: RenderJob, run: Callable[[], None]) -> None:
        """Run a job by calling `run`, which raises none of the job's errors."""

    @abstractmethod
    def on_failure(self, name: str, error: BaseException) -> None:
        """Decide the consequences of a job's error, before RQ records that it failed."""

    @abstractmethod
    def on_done(self) -> int | None:
        """Look back at a job that has ended; an exit code ends the worker."""

    @abstractmethod
    def on_end(self) -> None:
        """Clean up before RQ forgets the worker; a redis.RedisError is ignored."""

    # ------------------------------------------------------------------------------------------------------------ work

    def work_on(self) -> int | None:
        """Work until a hook gives an exit code or raises; None once a signal asked to stop, after the job in hand."""
        self.bootstrap(logging_level="WARNING")
        self._install_signal_handlers()
        try:
            while not self._stop_requested:
                self.heartbeat()
                job = self.next_job()
                if job is not None:
                    self.execute_job(job, self._queue)
                code = self.on_idle() if job is None else self.on_done()
                if code is not None:
                    return code
        except StopRequested:  # while no job was in hand
            pass
        finally:
            with contextlib.suppress(redis.RedisError):
                self.on_end()
                self.teardown()
        return None

    def execute_job(self, job: RenderJob, queue: RenderQueue) -> None:
        """Run one job, as `on_job` does it."""
        self.set_state(WorkerStatus.BUSY)  # if it is asked to stop from here on, RQ ends the job first
        self.on_job(job, partial(super().execute_job, job, queue))

    def handle_exception(self, job: RenderJob, kind: type[BaseException], error: BaseException, trace: Any) -> None:  # noqa: ARG002
        """Leave the consequences of an error to `on_failure`."""
        self.on_failure(job.id, error)

    def subscribe(self) -> None:
        """Do nothing: by RQ's commands any client of Redis could stop workers and jobs, and nothing needs them."""

    def run_maintenance_tasks(self) -> None:
        """Do nothing: `reconcile` does the maintenance, without loading strangers' jobs."""

    def get_heartbeat_ttl(self, job: RenderJob) -> int:  # noqa: ARG002
        """How long RQ's own records of a running job last, in seconds."""
        return self._job_ttl_s
