"""The settings of a worker, which the command line passes to its supervisor, and that to its child."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from photonfarm.shared.scene.spec import Count, Frozen, Positive

GRACE_S = 5.0
"""The seconds for a job in hand to end once its worker is to stop.

A job that is nearly done is kept, and the worker is gone within the 10 s that Docker gives. A longer job is killed, and
as it has no marker it is rendered again.
"""

RECYCLED = 75
"""The exit code of a child that is due for a successor."""

JOB_IN_HAND = "job in hand: "
"""The line's beginning by which a child reports the job that it begins, before the job's name."""

JOBS_SO_FAR = "so far: "
"""The line's beginning by which a child reports its jobs so far, before the numbers of `JobCounts`."""

LOG_FORMAT = "%(asctime)s %(name)s: %(message)s"
"""The format of log lines of a supervisor and its child."""


class WorkerSettings(Frozen):
    """The settings of a worker; each default with its reason."""

    model_config = ConfigDict(hide_input_in_errors=True)  # the URL may hold a password

    store: str
    redis_url: Annotated[str, Field(repr=False)]
    name: Annotated[str, Field(min_length=1, max_length=128)]
    until_complete: bool = False
    scene_id: str | None = None  # fill the queue with, and wait for, this scene alone; None: the whole store
    quiet: bool = False  # log only problems
    max_jobs: Count = 500  # then a fresh child: bounds what leaks, at < 1 % of the time
    max_rss_bytes: Count = 8 << 30  # a CPU worker needs about 1 GB; GPU contexts some more
    deadline_s: Positive = 1800.0  # jobs are meant to take 5 to 30 s; a hundred times that is a hang
    heartbeat_ttl_s: Positive = 90.0  # longer than native code holds Python's lock
    steady_s: Positive = 30.0  # a child that lived this long was healthy: its successor starts at once
    idle_s: Count = 2  # between looks at the store, while the queue is empty
    report_s: Positive = 60.0  # between lines about the progress
    reserve_bytes: Annotated[int, Field(ge=0)] = 10**9  # a few jobs, and room for whatever else needs the disk
    ahead: Annotated[float, Field(ge=1)] | None = None  # a scene's samples committed for each that its trainer has used
