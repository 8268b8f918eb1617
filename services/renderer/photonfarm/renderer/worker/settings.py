"""The settings of a worker, which its supervisor passes to its child, and what a child tells its supervisor."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from photonfarm.core.errors import QueueError
from photonfarm.core.models import Count, Frozen, Positive
from photonfarm.queue.job import Share

GRACE_S = 5.0
"""The seconds that a job in hand has to end after its worker was asked to stop.

So a job that is nearly done is kept, and the worker ends within the 10 s that Docker allows. A longer job is killed; as
it has no marker, it is rendered again.
"""

RECYCLED = 75
"""The exit code of a child that is worn out, or was stopped alone: its supervisor starts a new one at once."""

REFUSED = 76
"""The exit code of a child whose Redis refuses it, and would refuse any other: its supervisor ends."""

JOB_IN_HAND, JOB_ENDED = "job in hand: ", "job ended: "
"""How lines begin in which a child reports the job that it begins, by its name, and how it has ended.

It is "done", put back ("again"), "failed", or "left" to another worker.
"""

LOG_FORMAT = "%(asctime)s %(name)s: %(message)s"
"""The format of log lines of a supervisor and its child."""


class WorkerSettings(Frozen):
    """The settings of a worker; comments give the reason for each default."""

    model_config = ConfigDict(hide_input_in_errors=True)  # the URL may hold a password

    store: str
    redis_url: Annotated[str | None, Field(repr=False)] = None  # None: only with a share
    share: Share | None = None  # of the jobs, taken from the store alone; None: jobs come from Redis
    scene_ids: tuple[str, ...] = ()  # the only scenes of a share; none: all of the store; not beside `scene_id`
    name: Annotated[str, Field(min_length=1, max_length=128)]
    until_complete: bool = False
    scene_id: str | None = None  # the only scene to queue jobs of and to wait for; None: all; not beside `scene_ids`
    quiet: bool = False  # log only problems
    max_jobs: Count = 500  # after so many a new child starts, which bounds memory leaks and takes < 1 % of the time
    max_rss_bytes: Count = 8 << 30  # a CPU worker needs about 1 GB; GPU contexts some more
    deadline_s: Positive = 1800.0  # jobs are meant to take 5 to 30 s; a hundred times that is a hang
    heartbeat_ttl_s: Positive = 60.0  # after which a worker of another machine, and its job, count as lost
    steady_s: Positive = 30.0  # a child that lived this long was healthy: its successor starts at once
    idle_s: Count = 2  # between checks of the store while the queue is empty
    report_s: Positive = 60.0  # between lines about the progress
    reserve_bytes: Annotated[int, Field(ge=0)] = 10**9  # a few jobs, and room for whatever else needs the disk
    ahead: Annotated[float, Field(ge=1)] | None = None  # the most committed samples for each that the trainer has used

    @property
    def scenes(self) -> tuple[str, ...]:
        """The ids of the only scenes to render; none: all scenes of the store."""
        return self.scene_ids if self.scene_id is None else (self.scene_id,)

    @property
    def queue_url(self) -> str:
        """The queue's Redis; raises QueueError without one."""
        if self.redis_url is None:
            raise QueueError("a worker needs a Redis, or a share of the jobs such as 0/4")
        return self.redis_url
