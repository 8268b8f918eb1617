"""Jobs as RQ has them: names, from which everything else follows.

RQ imports and calls any dotted name that stands in Redis, also for callbacks and with JSON as well as pickle, and
sends webhooks anywhere. So a job here is its name, `<scene id>-<number>`, checked. What else Redis holds of it is JSON
for RQ's own tools, and is never read here: neither function nor arguments, callbacks, time limits or dependents; it may
be as large as it likes.
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
"""The one function that a job runs; a string, since whoever submits needs no renderer."""

FAILURE_TTL_S = 3600
"""A failed job is left alone for an hour: long enough not to burn cores on it, short enough to heal by itself."""

RQ_TIMEOUT_S = 7 * 86400
"""RQ's own time limit cannot interrupt native code, so it is out of the way; the worker's deadline counts."""

STARTS = "rq:photonfarm:starts:"
OVERDUE = "rq:photonfarm:overdue:"

MAX_NAME = 64
"""Bytes of a job's name at most; what is longer is not even fetched."""

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
    """What a job's arguments may be."""

    scene_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", strict=True)]
    job: Annotated[int, Field(ge=0, lt=1 << 48, strict=True)]

    @classmethod
    def of(cls, name: str) -> RenderArguments:
        """The arguments that a job's name tells; raises QueueError for a name that is none."""
        scene_id, _, number = name.rpartition("-")
        try:
            arguments = cls(scene_id=scene_id, job=int(number) if number.isdecimal() else -1)
        except ValidationError as error:
            raise QueueError(f"job {name[:MAX_NAME]!r}: {'; '.join(sentences(error))}") from error
        if job_name(arguments.scene_id, arguments.job) != name:  # leading zeros, digits of other scripts
            raise QueueError(f"job {name[:MAX_NAME]!r}: is not written as job {arguments.job}")
        return arguments


class RenderJob(Job):
    """A job that can only be ours, whatever Redis holds of it."""

    _refusal: str | None = None

    def refuse(self, reason: str) -> None:
        """Make the job fail for a reason instead of running."""
        self._refusal = reason

    def refresh(self) -> None:
        """Be the job of this name, without looking into Redis; raises QueueError if it is no job's."""
        self.restore({})

    def restore(self, raw_data: Any) -> None:  # noqa: ARG002
        """Be the job of this name; what Redis holds of it is not looked at."""
        self.func_name = FUNCTION
        self.instance, self.args, self.kwargs = None, (), RenderArguments.of(self.id).model_dump()
        self.origin, self.description = QUEUE, self.id
        self.timeout, self.result_ttl, self.failure_ttl = RQ_TIMEOUT_S, 0, FAILURE_TTL_S
        self.created_at = self.enqueued_at = now()
        self._status = JobStatus.QUEUED

    def get_status(self, refresh: bool = True) -> JobStatus:  # noqa: ARG002
        """The status as this worker left it, also once Redis has forgotten it."""
        return self._status

    @property
    def func(self) -> Any:
        """The one function; raises IncompleteError for a job that was refused."""
        if self._refusal:
            raise IncompleteError(f"job {self.id} is not run: {self._refusal}")
        return import_attribute(FUNCTION)


class RenderQueue(Queue):
    """RQ's queue, whose jobs have no dependents: whoever wrote them into Redis."""

    job_class = RenderJob

    def enqueue_dependents(self, *args: Any, **options: Any) -> None:
        """Nothing."""


def open_queue(connection: Redis) -> RenderQueue:
    """The queue. A worker listens to this one alone: on several, RQ would lose a job with the worker that took it.

    What is under its keys, and under RQ's registries, and is of another kind, has been removed. Raises RedisError.
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
    """The next job, taken as RQ takes it, or None; and how many entries that were no jobs were thrown away.

    Jobs of other scenes than `scene_id`, and of those to `leave`, stay where they are, for other workers. Whoever wants
    to wait asks again: blocking, RQ fetches whatever stands in the list, of whatever size.
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
    """Have a job that was taken be the next one to be taken, by a worker that can do it."""
    with queue.connection.pipeline() as pipeline:
        pipeline.lrem(queue.key, 0, name)
        pipeline.lpush(queue.key, name)
        pipeline.execute()


def queued_names(queue: RenderQueue) -> list[str]:
    """The names in the queue, in order, without those too long to be ours."""
    return [name.decode(errors="replace") for name in _names(queue, queue.key, "LRANGE")]


def taken_names(queue: RenderQueue) -> list[bytes]:
    """The names that were taken and are not said to have ended, as they stand there; without those too long."""
    return _names(queue, queue.intermediate_queue_key, "LRANGE")


def running_names(queue: RenderQueue) -> list[bytes]:
    """The entries of RQ's registry of running jobs, as they stand there: name, colon, execution."""
    return _names(queue, queue.started_job_registry.key, "ZRANGE")


def _names(queue: RenderQueue, key: str, command: str) -> list[bytes]:
    found: list[bytes] = queue.connection.register_script(_NAMES)(keys=[key], args=[command])
    return found
