"""The store that a Redis serves: one at a time, as its workers take any queued job.

A worker for another store would drop the jobs that it does not know. So every process that queues or works registers
its store, and is refused while another store is registered. A registration ends soon after the last worker.
"""

from __future__ import annotations

import redis
from redis import Redis

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.queue.heartbeat import WORKER
from photonfarm.shared.queue.untrusted import names_below
from photonfarm.shared.store import Store

SERVED = "rq:photonfarm:store"

SERVED_TTL_S = 120
"""How long a registration lasts unless it is renewed; workers renew it with every heartbeat."""

_SERVE = """
local function served()
  if redis.call('TYPE', KEYS[1]).ok ~= 'string' then return '' end
  local id, left_ms = redis.call('GETRANGE', KEYS[1], 0, 32), redis.call('PTTL', KEYS[1])
  if #id ~= 32 or string.find(id, '[^0-9a-f]') then return '' end
  if left_ms < 0 or left_ms > ARGV[2] * 1000 then return '' end
  return id
end
local id = served()
if id ~= '' and id ~= ARGV[1] then return {id, redis.call('PTTL', KEYS[1])} end
if ARGV[3] == 'say' then redis.call('SET', KEYS[1], ARGV[1], 'EX', ARGV[2]) end
return {'', 0}
"""

_RELEASE = """
if redis.call('TYPE', KEYS[1]).ok == 'string' and redis.call('GETRANGE', KEYS[1], 0, 32) == ARGV[1] then
  redis.call('DEL', KEYS[1])
end
"""


class OtherStoreError(QueueError):
    """A Redis serves another store than the caller's."""


def serve(connection: Redis, store: Store) -> None:
    """Register for a while that this Redis serves a store.

    Raises OtherStoreError if it serves another, and QueueError if it fails. A value that is not a store's id, or that
    would not expire, is a stranger's and is ignored.
    """
    _ask(connection, store, "say")


def check_served(connection: Redis, store: Store) -> None:
    """Check that this Redis serves no other store; raises OtherStoreError if it does, QueueError if it fails."""
    _ask(connection, store, "ask")


def _ask(connection: Redis, store: Store, how: str) -> None:
    try:
        found = connection.register_script(_SERVE)(keys=[SERVED], args=[store.store_id, SERVED_TTL_S, how])
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while it was asked which store it serves: {error}") from error
    other, left_ms = found[0].decode(), int(found[1])
    if other:
        raise OtherStoreError(
            f"this Redis serves the store with the id {other}, and {store.storage.where} has the id {store.store_id}; "
            "give the store that is meant (--store), or another database of Redis for this one (redis://host/1; with "
            "`photonfarm up`, another --run). If nobody works with the other store any more, wait: this Redis is free "
            f"by itself in {max(1, -(-left_ms // 1000))} s"
        )


def release(connection: Redis, store: Store) -> None:
    """End the registration of a store when its last worker has ended. Raises redis.RedisError."""
    if not names_below(connection, WORKER):
        connection.register_script(_RELEASE)(keys=[SERVED], args=[store.store_id])
