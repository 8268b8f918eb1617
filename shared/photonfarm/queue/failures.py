"""Jobs that failed: why, how often, and what they have in common.

A job that fails or loses its worker is tried again; after so many tries it is set aside, until `photonfarm submit
--retry`. A Redis that loses its data forgets this as well. So each failure is also kept in the store, as a small file
that is written once: for people, who ask later why a job is missing; and for workers without Redis, who try a failed
job as often as the queue does, and then leave it alone. All times are those of the writers' clocks, so these must agree
to within minutes.
"""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from photonfarm.queue.job import TRIES, RenderArguments, is_job_name
from photonfarm.store import Store
from photonfarm.store.io.storage import put_json
from photonfarm.store.model.store import FAILURES_FOLDER

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


def shorten(reason: str) -> str:
    """A reason as it is kept: one line, not too long."""
    return " ".join(reason.split())[:REASON_LETTERS]


def group_causes(failures: Mapping[str, Failure]) -> list[FailureCause]:
    """Failures by their cause, the most frequent first."""
    jobs: dict[str, dict[str, Failure]] = {}
    for name, failure in sorted(failures.items(), key=lambda item: (not item[1].set_aside, item[0])):
        jobs.setdefault(_VARYING.sub("…", failure.reason), {})[name] = failure
    return sorted((FailureCause(*cause) for cause in jobs.items()), key=lambda cause: -len(cause.jobs))


def repeating_command(store: str | Path, name: str) -> str:
    """The command that renders a job again in the foreground, and prints its whole error."""
    job = RenderArguments.of(name)
    return shlex.join(["photonfarm", "work", "--store", str(store), "--scene", job.scene_id, "--job", str(job.job)])


_FILE = re.compile(r"(.+)\.([0-9]{1,16})\.json")

RETRIED = "retried"
"""The name of a file that forgets the failures before it."""


def keep_failure(store: Store, name: str, reason: str, *, worker: str) -> None:
    """Keep why a job failed just now. Raises OSError if the store refuses."""
    _keep(store, name, {"job": name, "reason": shorten(reason), "worker": worker})


def keep_retry(store: Store) -> None:
    """Keep that all failed jobs are to be tried again, if any failure is kept. Raises OSError if the store refuses."""
    if store.storage.names(FAILURES_FOLDER):
        _keep(store, RETRIED, {})


def _keep(store: Store, name: str, document: dict[str, str]) -> None:
    at_ms = time.time_ns() // 1_000_000
    put_json(store.storage, {**document, "at_s": at_ms / 1000}, f"{FAILURES_FOLDER}/{name}.{at_ms}.json")


def read_kept_failures(store: Store, wanted: Callable[[str], bool] = lambda _: True) -> dict[str, Failure]:
    """The last kept failure of each of the `wanted` jobs since all were retried, by its name.

    Raises OSError if the store cannot be read.
    """
    return {
        name: Failure(_reason(store, name, max(times_ms)), len(times_ms))
        for name, times_ms in sorted(_times_ms(store).items())
        if wanted(name)
    }


def count_failures(store: Store) -> dict[str, int]:
    """How often each job has failed since all were retried, by its name, for one listing. Raises OSError."""
    return {name: len(times_ms) for name, times_ms in _times_ms(store).items()}


def _times_ms(store: Store) -> dict[str, list[int]]:
    """When jobs failed, in milliseconds since 1970, as the names of the files tell."""
    matches = [match for file in store.storage.names(FAILURES_FOLDER) if (match := _FILE.fullmatch(file))]
    retried = max((int(match[2]) for match in matches if match[1] == RETRIED), default=-1)
    failed: dict[str, list[int]] = {}
    for name, at_ms in ((match[1], int(match[2])) for match in matches):
        if is_job_name(name) and at_ms > retried:
            failed.setdefault(name, []).append(at_ms)
    return failed


def _reason(store: Store, name: str, at_ms: int) -> str:
    try:
        return shorten(json.loads(store.storage.read(f"{FAILURES_FOLDER}/{name}.{at_ms}.json"))["reason"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "the record of the failure cannot be read"
