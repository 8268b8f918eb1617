"""What a worker is told, by the command line to its supervisor and by that to its child."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from photonfarm.shared.scene import Frozen

GRACE_S = 5.0
"""What a job in hand gets to end in once its worker is to stop: one that is nearly done is kept, and the worker is gone
within the 10 s that Docker gives. A longer job is killed, and as it has no marker it is rendered again."""

RECYCLED = 75
"""Exit code of a child that wants a successor."""

Positive = Annotated[float, Field(gt=0)]


class WorkerSettings(Frozen):
    """What a worker is told; each default with its reason."""

    store: str
    redis_url: str
    name: Annotated[str, Field(min_length=1, max_length=128)]
    until_complete: bool = False
    scene_id: str | None = None  # fill the queue with, and wait for, this scene alone; None: all of the store
    max_jobs: Annotated[int, Field(ge=1)] = 500  # then a fresh child: bounds what leaks, at < 1 % of the time
    max_rss_bytes: Annotated[int, Field(ge=1)] = 8 << 30  # a CPU worker needs about 1 GB; GPU contexts some more
    deadline_s: Positive = 1800.0  # jobs are meant to take 5 to 30 s; a hundred times that is a hang
    heartbeat_ttl_s: Positive = 90.0  # longer than native code holds Python's lock
    idle_s: Annotated[int, Field(ge=1)] = 2  # between looks at the store, while the queue is empty
