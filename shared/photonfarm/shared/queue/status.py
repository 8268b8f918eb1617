"""The queue and the workers, as Redis has them; without RQ, which takes its time to load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import redis
from redis import Redis

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.queue.failures import Failure, read_failures
from photonfarm.shared.queue.heartbeat import ALIVE, workers_alive
from photonfarm.shared.queue.idle_workers import IdleReports, read_idle_reports
from photonfarm.shared.queue.job import QUEUE_KEY
from photonfarm.shared.queue.untrusted import names_below, remove_others
from photonfarm.shared.queue.worker_activity import Activity, read_activities


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """The queue and the workers, as Redis has them."""

    queued: int
    running: int  # jobs with a heartbeat
    workers: int  # with a heartbeat; those of this machine only if their process lives
    failed: dict[str, Failure]  # by job name
    idle_reports: IdleReports
    activities: Mapping[str, Activity] = field(default_factory=dict)  # by worker


def queue_status(connection: Redis) -> QueueStatus:
    """Jobs queued, running and failed, and workers; raises QueueError if Redis fails."""
    try:
        remove_others(connection, {QUEUE_KEY: "list"})
        return QueueStatus(
            queued=connection.llen(QUEUE_KEY),
            running=len(names_below(connection, ALIVE)),
            workers=len(workers_alive(connection)),
            failed=read_failures(connection),
            idle_reports=read_idle_reports(connection),
            activities=read_activities(connection),
        )
    except redis.RedisError as error:
        raise QueueError(f"Redis failed while it was asked for its status: {error}") from error
