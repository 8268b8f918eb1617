"""The names in RQ's lists: the next one taken, one put back, and all of them, none longer than a job's.

Scripts drop what is no name of a job before it is fetched.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.queue.job import MAX_NAME

if TYPE_CHECKING:
    from photonfarm.shared.queue.rq_adapter import RenderJob, RenderQueue

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
        return queue.job_named(name.decode()), dropped
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
