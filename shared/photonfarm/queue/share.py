"""Jobs shared by the store alone, where there is no Redis: a worker's own jobs first, and then whatever is left.

Worker K of N owns the jobs whose number leaves K when it is divided by N. Nobody reserves a job: two workers may render
the same one, which costs the time of the second and no more, as the first commit stays.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from photonfarm.core.errors import SpecError
from photonfarm.core.models import Count, Frozen


class Share(Frozen):
    """One of `of` equal shares of the jobs, numbered from 0."""

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
