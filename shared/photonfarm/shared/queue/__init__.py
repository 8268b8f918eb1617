"""The queue: RQ, whose jobs are only names, and `reconcile`, which fills it from the store.

Redis is disposable: every job in it can be derived again from plans and markers. It is also not trusted: a client that
can write to it can delay jobs, but can neither run code in a worker nor change what is stored. Our keys, beside RQ's:

alive:<job name>                    heartbeat of a job being rendered; the value is the worker's name
rq:photonfarm:failed:<job name>     why a job failed; it is not queued again while this lasts
rq:photonfarm:failures:<job name>   how often a job has failed
rq:photonfarm:starts:<job name>     how often a job was started without reporting an end
rq:photonfarm:overdue:<job name>    how many of these starts the deadline has ended
rq:photonfarm:worker:<worker name>  heartbeat of a worker; the value is its host with the process space, the
job it renders, or -, and the process of its supervisor
rq:photonfarm:paused:<worker name>  why a worker takes no jobs
rq:photonfarm:left:<scene id>:<worker name>  why a worker skips a scene
rq:photonfarm:doing:<worker name>   what a worker is doing, and how far it is
rq:photonfarm:reconcile             lock of the process that fills the queue
rq:photonfarm:looked:<scene id, or all>  what the last look at the store found, for seconds
rq:photonfarm:store                 the id of the store that this Redis serves, while it is in use
rq:photonfarm:consumed:<scene id>   samples of a scene that its trainer has used
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from photonfarm.shared.queue.connection import connect, has_password, with_password_of
from photonfarm.shared.queue.consumption import consumed_samples, report_consumed
from photonfarm.shared.queue.entries import put_back, take
from photonfarm.shared.queue.failures import (
    FAILED,
    FAILURES_ALLOWED,
    Failure,
    FailureCause,
    causes,
    count_overdue,
    count_start,
    forget_failures,
    forget_failures_of,
    forget_starts_of,
    overdue,
    record_failure,
    repeating_command,
)
from photonfarm.shared.queue.heartbeat import ALIVE, WORKER, beat, bury, free_job, hosts, job_of_worker, take_name
from photonfarm.shared.queue.idle_workers import IdleReports, clear_idle_report, report_idle
from photonfarm.shared.queue.job import FUNCTION, OVERDUE, QUEUE, STARTS, RenderArguments, job_name
from photonfarm.shared.queue.kept_failures import jobs_left_alone, keep_failure, keep_submission, kept_failures
from photonfarm.shared.queue.served_store import SERVED, OtherStoreError, check_served, release, serve
from photonfarm.shared.queue.share import Share
from photonfarm.shared.queue.status import QueueStatus, queue_status
from photonfarm.shared.queue.worker_activity import Activity, clear_activity, report_activity

if TYPE_CHECKING:
    from photonfarm.shared.queue.reconciliation import QUEUE_LIMIT, look, reconcile
    from photonfarm.shared.queue.rq_adapter import QueueWorker, RenderJob, open_queue
else:
    _WITH_RQ = {
        "QUEUE_LIMIT": "reconciliation",
        "look": "reconciliation",
        "reconcile": "reconciliation",
        "QueueWorker": "rq_adapter",
        "RenderJob": "rq_adapter",
        "open_queue": "rq_adapter",
    }

    def __getattr__(name: str) -> Any:
        """What needs RQ, which is loaded only when it is asked for: `status` asks for none of it."""
        if name not in _WITH_RQ:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_WITH_RQ[name]}"), name)


__all__ = [
    "ALIVE",
    "FAILED",
    "FAILURES_ALLOWED",
    "FUNCTION",
    "OVERDUE",
    "QUEUE",
    "QUEUE_LIMIT",
    "SERVED",
    "STARTS",
    "WORKER",
    "Activity",
    "Failure",
    "FailureCause",
    "IdleReports",
    "OtherStoreError",
    "QueueStatus",
    "QueueWorker",
    "RenderArguments",
    "RenderJob",
    "Share",
    "beat",
    "bury",
    "causes",
    "check_served",
    "clear_activity",
    "clear_idle_report",
    "connect",
    "consumed_samples",
    "count_overdue",
    "count_start",
    "forget_failures",
    "forget_failures_of",
    "forget_starts_of",
    "free_job",
    "has_password",
    "hosts",
    "job_name",
    "job_of_worker",
    "jobs_left_alone",
    "keep_failure",
    "keep_submission",
    "kept_failures",
    "look",
    "open_queue",
    "overdue",
    "put_back",
    "queue_status",
    "reconcile",
    "record_failure",
    "release",
    "repeating_command",
    "report_activity",
    "report_consumed",
    "report_idle",
    "serve",
    "take",
    "take_name",
    "with_password_of",
]
