"""Jobs: checked names, `<scene id>-<number>`, from which everything else follows; and shares of them.

Where there is no Redis, the store alone says what is missing. Then worker K of N owns the jobs whose number modulo N
is K. Nobody reserves a job: two workers may render the same one, which costs the time of the second
and no more, as the first commit stays.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from photonfarm.core.errors import QueueError, SpecError
from photonfarm.core.models import Count, Frozen

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


def scene_of(name: str) -> str:
    """The scene id in a job's name; of other text, what is before its last hyphen."""
    return name.rpartition("-")[0]


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


class Share(Frozen):
    """One of `of` equal shares of the jobs, numbered from 0; a worker takes those of its own first."""

    number: Annotated[int, Field(ge=0)]
    of: Count

    @model_validator(mode="after")
    def _is_one_of_them(self) -> Self:
        if self.number >= self.of:
            raise ValueError(f"{self}: shares are numbered from 0, so the last of {self.of} is {self.of - 1}")
        return self

    @classmethod
    def parse(cls, text: str) -> Share:
        """The share that is written as K/N; raises SpecError for any other text."""
        number, _, of = text.partition("/")
        digits = number + of
        if not (number and of and digits.isascii() and digits.isdecimal() and int(number) < int(of)):
            raise SpecError(f"share {text!r}: K/N is required, with K from 0 to N - 1, as 0/4 to 3/4")
        return cls(number=int(number), of=int(of))

    def __str__(self) -> str:
        """The share as it is written."""
        return f"{self.number}/{self.of}"

    def order(self, missing: Collection[int]) -> list[int]:
        """Missing jobs of a scene in the order in which this worker takes them.

        Its own come first, in ascending order. The others follow in an order that differs from share to share, so that
        workers who help out rarely meet. The first missing job of each other share comes last: its owner has probably
        begun it.
        """
        own = sorted(job for job in missing if self.owns(job))
        others = sorted(job for job in missing if not self.owns(job))
        begun: dict[int, int] = {}
        for job in others:
            begun.setdefault(job % self.of, job)
        waiting = [job for job in others if begun[job % self.of] != job]
        return own + self._shuffled(waiting) + self._shuffled(list(begun.values()))

    def owns(self, job: int) -> bool:
        """Whether a job is one of this share."""
        return job % self.of == self.number

    def _shuffled(self, jobs: list[int]) -> list[int]:
        return [jobs[place] for place in np.random.default_rng([self.number, self.of]).permutation(len(jobs))]
