"""Workers as they tell of themselves, in the hash that RQ has for each: who is alive, doing what, and why idle.

Redis drops a hash by its own clock unless it is written again. Beside RQ's fields it has one of ours, a JSON document;
what it says is for people, and no decision depends on it but whether a name is taken.

A Redis serves one store at a time, as its workers take any queued job: a worker for another store would drop the jobs
that it does not know. So every process that queues or works registers its store, and is refused while another store is
registered. A registration ends soon after the last worker.

A trainer reports how many samples it has used, so that workers need not run far ahead. It does so repeatedly: a Redis
that lost the number has it again within seconds.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from itertools import count

from redis import Redis
from redis.client import Pipeline

from photonfarm.core.errors import QueueError
from photonfarm.core.processes import is_gone, process_space
from photonfarm.queue.connection import redis_errors
from photonfarm.queue.job import QUEUE, STARTED_KEY
from photonfarm.store import Store

WORKER = "rq:worker:"
ALL_WORKERS, WORKERS = "rq:workers", f"rq:workers:{QUEUE}"
"""RQ's sets of the keys of all workers, and of those of our queue."""

REPORT = "photonfarm"
"""The field of the hash that is ours."""


@dataclass(frozen=True, slots=True)
class Activity:
    """What a worker is doing."""

    phase: str  # such as "renders samples"
    done: int = 0  # samples of its job that are rendered, and not committed yet
    total: int = 0  # of so many; 0: the phase has no parts
    job: str | None = None  # its name

    def __str__(self) -> str:
        """The activity in words."""
        return f"{self.phase} {self.done}/{self.total}" if self.total else self.phase


@dataclass(frozen=True, slots=True)
class WorkerReport:
    """What a worker tells of itself."""

    host: str = field(default_factory=process_space)  # in which `process` counts
    process: int = field(default_factory=os.getpid)  # its supervisor's
    doing: Activity | None = None
    paused: str | None = None  # why it takes no jobs
    left: Mapping[str, str] = field(default_factory=dict)  # why it takes none of some scenes, by their ids

    @classmethod
    def of(cls, text: bytes | str) -> WorkerReport:
        """The report in a worker's hash."""
        report = json.loads(text)
        return cls(**report | {"doing": Activity(**report["doing"]) if report["doing"] else None})

    @property
    def has_ended(self) -> bool:
        """Whether it is of this machine, and its process has ended."""
        return self.host == process_space() and is_gone(self.process)


def decode_text(value: object) -> str:
    """What Redis holds, as text."""
    return value.decode() if isinstance(value, bytes) else str(value)


def take_name(connection: Redis, wanted: str, *, ttl_s: float) -> str:
    """Take a name for a worker of this process: this one, or with a number behind it while another worker has it."""
    for number in count(1):
        name = wanted if number == 1 else f"{wanted}-{number}"
        written = connection.hget(WORKER + name, REPORT)
        if written is not None and WorkerReport.of(written).has_ended:
            bury(connection, name)
        if connection.hsetnx(WORKER + name, REPORT, json.dumps(asdict(WorkerReport()))):
            with connection.pipeline() as pipeline:
                beat(pipeline, name, WorkerReport(), ttl_s=ttl_s)
                pipeline.execute()
            return name
    raise AssertionError  # count() does not end


def beat(pipeline: Pipeline, name: str, report: WorkerReport, *, ttl_s: float) -> None:
    """Write that a worker is alive, and what it tells; all of it, as Redis may have lost it."""
    key, now = WORKER + name, datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    known = {
        "last_heartbeat": now,
        "queues": QUEUE,
        "pid": report.process,
        "hostname": socket.gethostname(),
        "state": "busy" if report.doing else "idle",
        REPORT: json.dumps(asdict(report)),
    }
    pipeline.hsetnx(key, "birth", now)
    pipeline.hset(key, mapping=known)  # type: ignore[arg-type]
    pipeline.pexpire(key, int(1000 * ttl_s))
    for workers in (ALL_WORKERS, WORKERS):
        pipeline.sadd(workers, key)


def bury(connection: Redis, name: str) -> None:
    """Remove a worker."""
    with connection.pipeline() as pipeline:
        pipeline.delete(WORKER + name)
        for workers in (ALL_WORKERS, WORKERS):
            pipeline.srem(workers, WORKER + name)
        pipeline.execute()


def read_workers(connection: Redis) -> dict[str, WorkerReport]:
    """The workers that are alive, by name; those of this machine only if their process is. Forgets the others."""
    names = sorted(decode_text(key).removeprefix(WORKER) for key in connection.smembers(WORKERS))
    with connection.pipeline(transaction=False) as pipeline:
        for name in names:
            pipeline.hget(WORKER + name, REPORT)
        texts = pipeline.execute()
    reports = {name: WorkerReport.of(text) for name, text in zip(names, texts, strict=True) if text is not None}
    for name in names:
        if name not in reports:
            bury(connection, name)
    return {name: report for name, report in reports.items() if not report.has_ended}


def read_started(connection: Redis) -> dict[str, bool]:
    """RQ's entries of started jobs, `<name>:<execution>`, and whether their workers still tell of them.

    An execution's key ends by the clock of Redis, while RQ's own times are those of each worker's.
    """
    entries = [decode_text(entry) for entry in connection.zrange(STARTED_KEY, 0, -1)]
    with connection.pipeline(transaction=False) as pipeline:
        for entry in entries:
            pipeline.exists(f"rq:execution:{entry}")
        return dict(zip(entries, map(bool, pipeline.execute()), strict=True))


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
        other, left_ms = decode_text(connection.get(SERVED) or b""), connection.pttl(SERVED)
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


CONSUMED = "rq:photonfarm:consumed:"
CONSUMED_TTL_S = 7 * 86400
"""How long workers wait for a trainer that is down or has ended, as the ratio demands."""


def report_consumed(connection: Redis, scene_id: str, samples: int) -> None:
    """Report how many samples of a scene have been used, each counted once."""
    connection.set(CONSUMED + scene_id, samples, ex=CONSUMED_TTL_S)


def read_consumed(connection: Redis, scene_ids: Sequence[str]) -> dict[str, int]:
    """How many samples of each of these scenes its trainer has used, by its last report; 0 without one."""
    counts = connection.mget([CONSUMED + scene_id for scene_id in scene_ids]) if scene_ids else []
    return {scene_id: int(samples or 0) for scene_id, samples in zip(scene_ids, counts, strict=True)}
