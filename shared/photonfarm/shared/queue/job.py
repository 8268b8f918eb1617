"""Jobs: checked names, `<scene id>-<number>`, from which everything else follows."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, ValidationError

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.core.models import Frozen, sentences

QUEUE = "photonfarm"
QUEUE_KEY = f"rq:queue:{QUEUE}"
"""The list in which RQ keeps the names of the queued jobs."""

FUNCTION = "photonfarm.renderer.jobs.render.render_shard"
"""The one function that a job runs; a string, since submitting needs no renderer."""

FAILURE_TTL_S = 3600
"""A failed job is not queued for an hour: long enough not to burn cores on it, short enough to heal by itself."""

STARTS = "rq:photonfarm:starts:"
OVERDUE = "rq:photonfarm:overdue:"

MAX_NAME = 64
"""The most bytes of a job's name; longer ones are not even fetched."""


def job_name(scene_id: str, job: int) -> str:
    """The name of a job in the queue; RQ allows letters, digits, - and _."""
    return f"{scene_id}-{job}"


class RenderArguments(Frozen):
    """The valid arguments of a job."""

    scene_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$", strict=True)]
    job: Annotated[int, Field(ge=0, lt=1 << 48, strict=True)]

    @classmethod
    def of(cls, name: str) -> RenderArguments:
        """The arguments that a job's name stands for; raises QueueError for an invalid name."""
        scene_id, _, number = name.rpartition("-")
        try:
            arguments = cls(scene_id=scene_id, job=int(number) if number.isdecimal() else -1)
        except ValidationError as error:
            raise QueueError(f"job {name[:MAX_NAME]!r}: {'; '.join(sentences(error))}") from error
        if job_name(arguments.scene_id, arguments.job) != name:  # leading zeros, digits of other scripts
            raise QueueError(f"job {name[:MAX_NAME]!r}: is not written as job {arguments.job}")
        return arguments


def is_job_name(name: str) -> bool:
    """Whether a text is the name of a job."""
    try:
        RenderArguments.of(name)
    except QueueError:
        return False
    return True
