"""The queue and the workers, as Redis has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from redis import Redis

from photonfarm.shared.queue.connection import redis_errors
from photonfarm.shared.queue.failures import Failure
from photonfarm.shared.queue.job import QUEUE_KEY
from photonfarm.shared.queue.rq_adapter import open_queue, read_failures
from photonfarm.shared.queue.workers import Activity, read_workers, started


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """The queue and the workers, as Redis has them."""

    queued: int
    running: int  # jobs whose workers are alive
    workers: int  # alive; those of this machine only if their process is
    failed: dict[str, Failure]  # those set aside, by job name
    paused: Mapping[str, str] = field(default_factory=dict)  # by worker: why it takes no jobs
    left: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # by scene id and worker: why it skips it
    activities: Mapping[str, Activity] = field(default_factory=dict)  # by worker


def queue_status(connection: Redis) -> QueueStatus:
    """Jobs queued, running and failed, and workers; raises QueueError if Redis fails."""
    with redis_errors("asked for its status"):
        workers = read_workers(connection)
        left: dict[str, dict[str, str]] = {}
        for name, report in workers.items():
            for scene_id, reason in report.left.items():
                left.setdefault(scene_id, {})[name] = reason
        return QueueStatus(
            queued=connection.llen(QUEUE_KEY),
            running=sum(started(connection).values()),
            workers=len(workers),
            failed=read_failures(open_queue(connection)),
            paused={name: report.paused for name, report in workers.items() if report.paused},
            left=left,
            activities={name: report.doing for name, report in workers.items() if report.doing},
        )
