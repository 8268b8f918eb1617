"""Jobs that failed: why, how often, and what they have in common.

A job that fails or loses its worker is tried again; after so many tries it is set aside, until `photonfarm submit
--retry`. A Redis that loses its data forgets this as well.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from photonfarm.shared.queue.job import TRIES, RenderArguments

REASON_LETTERS = 2000

_VARYING = re.compile(r"\b[0-9a-f]{8,}\b|[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
"""The parts of a message that differ between failures of one cause: ids and numbers."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a job failed the last time."""

    reason: str  # the error's class and message, in one line
    times: int  # how often it has failed

    @property
    def set_aside(self) -> bool:
        """Whether it is not tried again."""
        return self.times >= TRIES


@dataclass(frozen=True, slots=True)
class FailureCause:
    """Failures whose error and message are the same but for ids and numbers."""

    cause: str  # the message with … for what differs
    jobs: dict[str, Failure]  # by name, those set aside first

    @property
    def set_aside(self) -> int:
        """How many of the jobs are set aside."""
        return sum(failure.set_aside for failure in self.jobs.values())

    @property
    def example(self) -> str:
        """The name of one of the jobs."""
        return next(iter(self.jobs))


def one_line(reason: str) -> str:
    """A reason as it is kept: one line, not too long."""
    return " ".join(reason.split())[:REASON_LETTERS]


def causes(failures: Mapping[str, Failure]) -> list[FailureCause]:
    """Failures by their cause, the most frequent first."""
    grouped: dict[str, dict[str, Failure]] = {}
    for name, failure in sorted(failures.items(), key=lambda item: (not item[1].set_aside, item[0])):
        grouped.setdefault(_VARYING.sub("…", failure.reason), {})[name] = failure
    return sorted((FailureCause(*found) for found in grouped.items()), key=lambda cause: -len(cause.jobs))


def repeating_command(store: str | Path, name: str) -> str:
    """The command that renders a job again in the foreground, and prints its whole error."""
    job = RenderArguments.of(name)
    return shlex.join(["photonfarm", "work", "--store", str(store), "--scene", job.scene_id, "--job", str(job.job)])
