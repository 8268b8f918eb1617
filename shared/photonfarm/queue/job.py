"""Jobs: checked names, `<scene id>-<number>`, from which everything else follows."""

from __future__ import annotations

import re
from typing import NamedTuple

from photonfarm.core.errors import QueueError

QUEUE = "photonfarm"
QUEUE_KEY, STARTED_KEY = f"rq:queue:{QUEUE}", f"rq:wip:{QUEUE}"
"""RQ's list of queued jobs, and its sorted set of started ones, `<name>:<execution>`."""

FUNCTION = "photonfarm.render"
"""The function that a job in Redis names. A worker renders such jobs, refuses others, and imports neither."""

TRIES = 5
"""How often a job is tried that fails or loses its worker, before it is set aside: so often is no accident."""

_NAME = re.compile("([0-9a-f]{32})-(0|[1-9][0-9]{0,13})")


def job_name(scene_id: str, job: int) -> str:
    """The name of a job in the queue; RQ allows letters, digits, - and _."""
    return f"{scene_id}-{job}"


class RenderArguments(NamedTuple):
    """The scene and the number of a job."""

    scene_id: str
    job: int

    @classmethod
    def of(cls, name: str) -> RenderArguments:
        """The arguments that a job's name stands for; raises QueueError for an invalid name."""
        if not (match := _NAME.fullmatch(name)):
            raise QueueError(f"job {name[:64]!r}: a name is <scene id>-<number>")
        return cls(match[1], int(match[2]))


def is_job_name(name: str) -> bool:
    """Whether a text is the name of a job."""
    return _NAME.fullmatch(name) is not None
