"""The queue: RQ, with jobs that are nothing but their names, and `reconcile`, which fills it from the store.

Redis is disposable: every job in it can be derived again from plans and markers. And it is not trusted: whoever can
write to it can delay jobs, and can neither run code in a worker nor change what is stored. Keys of ours, beside RQ's:

    alive:<job name>                    heartbeat of a job being rendered; the value is the worker's name
    rq:photonfarm:failed:<job name>     why a job failed; it is not queued again while this lasts
    rq:photonfarm:failures:<job name>   how often a job has failed
    rq:photonfarm:starts:<job name>     how often a job was started without an end
    rq:photonfarm:worker:<worker name>  heartbeat of a worker; the value is its host and the job it renders, or -
    rq:photonfarm:consumed:<scene id>   samples of a scene that its trainer has used
"""

from photonfarm.shared.queue.connection import connect, with_password_of
from photonfarm.shared.queue.consumption import consumed_samples, tell_consumed
from photonfarm.shared.queue.failures import (
    FAILED,
    FAILURES_ALLOWED,
    Cause,
    Failure,
    causes,
    forget_failures,
    forget_failures_of,
    record_failure,
    repeating_command,
)
from photonfarm.shared.queue.heartbeat import ALIVE, WORKER, beat, bury, hosts, job_of_worker
from photonfarm.shared.queue.job import (
    FUNCTION,
    QUEUE,
    STARTS,
    RenderArguments,
    RenderJob,
    job_name,
    open_queue,
    take,
)
from photonfarm.shared.queue.reconciliation import QUEUE_LIMIT, QueueStatus, queue_status, reconcile

__all__ = [
    "ALIVE",
    "FAILED",
    "FAILURES_ALLOWED",
    "FUNCTION",
    "QUEUE",
    "QUEUE_LIMIT",
    "STARTS",
    "WORKER",
    "Cause",
    "Failure",
    "QueueStatus",
    "RenderArguments",
    "RenderJob",
    "beat",
    "bury",
    "causes",
    "connect",
    "consumed_samples",
    "forget_failures",
    "forget_failures_of",
    "hosts",
    "job_name",
    "job_of_worker",
    "open_queue",
    "queue_status",
    "reconcile",
    "record_failure",
    "repeating_command",
    "take",
    "tell_consumed",
    "with_password_of",
]
