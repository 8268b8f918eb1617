"""Jobs in RQ: names, from which everything else follows.

RQ imports and calls any dotted name that stands in Redis, also for callbacks and with JSON as well as pickle, and
sends webhooks anywhere. So a job here is its name, `<scene id>-<number>`, checked. The rest of a job in Redis is JSON
for RQ's own tools and is never read here: no function, arguments, callbacks, time limits or dependents; so its size
does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import Field, ValidationError
from redis import Redis
from rq import Queue
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer
from rq.utils import as_text, import_attribute, now
from rq.worker_registration import REDIS_WORKER_KEYS, WORKERS_BY_QUEUE_KEY

from photonfarm.shared.core.errors import IncompleteError, QueueError
from photonfarm.shared.queue.untrusted import remove_others
from photonfarm.shared.scene.spec import Frozen, sentences

QUEUE = "photonfarm"
FUNCTION = "photonfarm.renderer.jobs.render.render_shard"
"""The one function that a job runs; a string, since submitting needs no renderer."""

FAILURE_TTL_S = 3600
"""A failed job is not queued for an hour: long enough not to burn cores on it, short enough to heal by itself."""

RQ_TIMEOUT_S = 7 * 86400
"""RQ's own time limit cannot interrupt native code, so it is too long to matter; the worker has its own deadline."""

STARTS = "rq:photonfarm:starts:"
OVERDUE = "rq:photonfarm:overdue:"

MAX_NAME = 64
"""The most bytes of a job's name; longer ones are not even fetched."""

_NAMES = f"""
local names = {{}}
for _, name in ipairs(redis.call(ARGV[1], KEYS[1], 0, -1)) do
  if #name <= 2 * {MAX_NAME} then names[#names + 1] = name end
end
return names
"""

_TAKE = f"""
local left, passed, dropped = {{}}, 0, 0
for i = 2, #ARGV do left[ARGV[i]] = true end
while dropped < 1000 do
  local names = redis.call('LRANGE', KEYS[1], passed, passed + 63)
  if #names == 0 then break end
  for _, name in ipairs(names) do
    local scene = #name <= {MAX_NAME} and string.match(name, '^(%x+)%-%d+$')
    if scene and (left[scene] or (ARGV[1] ~= '' and scene ~= ARGV[1])) then
      passed = passed + 1
    else
      redis.call('LREM', KEYS[1], 1, name)
      if scene then
        redis.call('RPUSH', KEYS[2], name)
        return {{name, dropped}}
      end
      dropped = dropped + 1
    end
  end
end
return {{'', dropped}}
"""


def job_name(scene_id: str, job: int) -> str:
    """The name of a job in the queue; RQ allows letters, digits, - and _."""
    return f"{scene_id}-{job}"


class RenderArguments(Frozen):
    """The valid arguments of a job."""

    scene_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", strict=True)]
    job: Annotated[int, Field(ge=0, lt=1 << 48, strict=True)]

    @classmethod
    def of(cls, name: str) -> RenderArguments:
        """The arguments that a job's name stands for; raises QueueError for an invalid name."""
        scene_id, _, number = name.rpartition("-")
        try:
            arguments = cls(scene_id=scene_id, job=int(number) if number.isdecimal() else -1)
        except ValidationError as error:
            raise QueueError(f"job {name[:MAX_NAME]!r}: {'; '.join(sentences(error))}") from error
        if job_name(arguments.scene_id, arguments.job) != name:  # leading zeros, digits of other scripts
            raise QueueError(f"job {name[:MAX_NAME]!r}: is not written as job {arguments.job}")
        return arguments


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
            REDIS_WORKER_KEYS: "set",
            WORKERS_BY_QUEUE_KEY % QUEUE: "set",
        },
    )
    return queue


def take(queue: RenderQueue, *, scene_id: str | None = None, leave: Iterable[str] = ()) -> tuple[RenderJob | None, int]:
    """Take the next job as RQ does; returns it or None, and how many invalid entries were dropped.

    Jobs of other scenes than `scene_id`, and of the scenes in `leave`, stay in the queue for other workers. To wait,
    call again: a blocking call of RQ would fetch any entry in the list, of any size.
    """
    keys = [queue.key, queue.intermediate_queue_key]
    name, dropped = queue.connection.register_script(_TAKE)(keys=keys, args=[scene_id or "", *leave])
    if not name:
        return None, dropped
    try:
        return RenderJob.fetch(as_text(name), connection=queue.connection, serializer=JSONSerializer), dropped
    except QueueError:
        queue.connection.lrem(queue.intermediate_queue_key, 1, name)
        return None, dropped + 1


def put_back(queue: RenderQueue, name: str) -> None:
    """Return a taken job to the head of the queue, for a worker that can render it."""
    with queue.connection.pipeline() as pipeline:
        pipeline.lrem(queue.key, 0, name)
        pipeline.lpush(queue.key, name)
        pipeline.execute()


def queued_names(queue: RenderQueue) -> list[str]:
    """The names in the queue, in order, without those too long for a job."""
    return [name.decode(errors="replace") for name in _names(queue, queue.key, "LRANGE")]


def taken_names(queue: RenderQueue) -> list[bytes]:
    """The names that were taken and not reported as ended, as stored; without those too long for a job."""
    return _names(queue, queue.intermediate_queue_key, "LRANGE")


def running_names(queue: RenderQueue) -> list[bytes]:
    """The entries of RQ's registry of running jobs, as stored: name, colon, execution."""
    return _names(queue, queue.started_job_registry.key, "ZRANGE")


def _names(queue: RenderQueue, key: str, command: str) -> list[bytes]:
    found: list[bytes] = queue.connection.register_script(_NAMES)(keys=[key], args=[command])
    return found
