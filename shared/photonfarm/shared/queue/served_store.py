"""The store that a Redis serves: one at a time, as its workers take any queued job.

A worker for another store would drop the jobs that it does not know. So every process that queues or works registers
its store, and is refused while another store is registered. A registration ends soon after the last worker.
"""

from __future__ import annotations

from redis import Redis

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.queue.connection import redis_errors
from photonfarm.shared.queue.workers import as_text, read_workers
from photonfarm.shared.store import Store

SERVED = "rq:photonfarm:store"

SERVED_TTL_S = 120
"""How long a registration lasts unless it is renewed; workers renew it with every heartbeat."""


class OtherStoreError(QueueError):
    """A Redis serves another store than the caller's."""


def serve(connection: Redis, store: Store) -> None:
    """Register for a while that this Redis serves a store.

    Raises OtherStoreError if it serves another, and QueueError if it fails.
    """
    with redis_errors("told which store it serves"):
        if connection.set(SERVED, store.store_id, ex=SERVED_TTL_S, nx=True):
            return
    check_served(connection, store)
    with redis_errors("told which store it serves"):
        connection.set(SERVED, store.store_id, ex=SERVED_TTL_S)


def check_served(connection: Redis, store: Store) -> None:
    """Check that this Redis serves no other store; raises OtherStoreError if it does, QueueError if it fails."""
    with redis_errors("asked which store it serves"):
        other, left_ms = as_text(connection.get(SERVED) or b""), connection.pttl(SERVED)
    if other and other != store.store_id:
        raise OtherStoreError(
            f"this Redis serves the store with the id {other}, and {store.storage.where} has the id {store.store_id}; "
            "give the store that is meant (--store), or another database of Redis for this one (redis://host/1; with "
            "`photonfarm up`, another --run). If nobody works with the other store any more, wait: this Redis is free "
            f"by itself in {max(1, -(-left_ms // 1000))} s"
        )


def release(connection: Redis, store: Store) -> None:
    """End the registration of a store when its last worker has ended. Raises redis.RedisError."""
    if not read_workers(connection) and connection.get(SERVED) == store.store_id.encode():
        connection.delete(SERVED)
