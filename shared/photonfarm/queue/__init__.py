"""The queue: RQ, whose jobs are only names, and `reconcile`, which fills it from the store.

Redis is disposable: every job in it can be derived again from plans and markers. Our keys, beside RQ's:

rq:worker:<name>, field photonfarm      what a worker tells of itself
rq:photonfarm:reconcile                 lock of the process that fills the queue
rq:photonfarm:looked:<scene id, or all> what the last look at the store found, for seconds
rq:photonfarm:store                     the id of the store that this Redis serves, while it is in use
rq:photonfarm:consumed:<scene id>       samples of a scene that its trainer has used
"""

from photonfarm.queue.connection import (
    RefusedError,
    add_password,
    connect,
    has_password,
    queue_error,
    redis_errors,
)
from photonfarm.queue.failures import (
    Failure,
    FailureCause,
    count_failures,
    group_causes,
    keep_failure,
    keep_retry,
    read_kept_failures,
    repeating_command,
)
from photonfarm.queue.job import QUEUE, TRIES, RenderArguments, is_job_name, job_name
from photonfarm.queue.reconciliation import QUEUE_LIMIT, fill_seldom, reconcile
from photonfarm.queue.rq_adapter import QueueStatus, queue_status
from photonfarm.queue.share import Share
from photonfarm.queue.workers import (
    SERVED,
    Activity,
    OtherStoreError,
    WorkerReport,
    beat,
    bury,
    check_served,
    read_consumed,
    read_workers,
    release,
    report_consumed,
    serve,
    take_name,
)

__all__ = [
    "QUEUE",
    "QUEUE_LIMIT",
    "SERVED",
    "TRIES",
    "Activity",
    "Failure",
    "FailureCause",
    "OtherStoreError",
    "QueueStatus",
    "RefusedError",
    "RenderArguments",
    "Share",
    "WorkerReport",
    "add_password",
    "beat",
    "bury",
    "check_served",
    "connect",
    "count_failures",
    "fill_seldom",
    "group_causes",
    "has_password",
    "is_job_name",
    "job_name",
    "keep_failure",
    "keep_retry",
    "queue_error",
    "queue_status",
    "read_consumed",
    "read_kept_failures",
    "read_workers",
    "reconcile",
    "redis_errors",
    "release",
    "repeating_command",
    "report_consumed",
    "serve",
    "take_name",
]
