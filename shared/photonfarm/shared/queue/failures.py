"""Jobs that failed: why, how often, which are set aside, and what they have in common.

A failed job is left alone for an hour and tried again; one that has failed three times is set aside, until
`photonfarm submit --retry`. A Redis that loses its memory forgets this as well: the job fails three times again then.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from redis import Redis

from photonfarm.shared.core.errors import QueueError
from photonfarm.shared.queue.job import FAILURE_TTL_S, OVERDUE, STARTS, RenderArguments
from photonfarm.shared.queue.untrusted import batches, beginnings, names_below, printable, remove_others

FAILED = "rq:photonfarm:failed:"
FAILURES = "rq:photonfarm:failures:"

FAILURES_ALLOWED = 3
"""Failures of one job after which it is set aside: by then it is no accident of one worker or one hour."""

FAILURES_TTL_S = 7 * 86400
STARTS_TTL_S = 6 * 3600
REASON_LETTERS = 2000

_VARYING = re.compile(r"\b[0-9a-f]{8,}\b|[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
"""What differs between failures of one cause: ids and numbers."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a job is not queued now."""

    reason: str  # the error's class and message
    times: int  # how often it has failed
    set_aside: bool  # else it is tried again within the hour


@dataclass(frozen=True, slots=True)
class Cause:
    """Failures whose error and message are the same but for ids and numbers."""

    cause: str  # the message with … for what differs
    set_aside: int
    jobs: dict[str, Failure]  # by name, those set aside first

    @property
    def example(self) -> str:
        """The name of one of the jobs."""
        return next(iter(self.jobs))


def record_failure(connection: Redis, name: str, reason: str) -> Failure:
    """Leave a job alone, and say why: for a while, or for good once it has failed too often."""
    remove_others(connection, {FAILURES + name: "counter"})
    times = int(connection.incr(FAILURES + name))
    connection.expire(FAILURES + name, FAILURES_TTL_S)
    set_aside = times >= FAILURES_ALLOWED
    said = printable(reason[:REASON_LETTERS])
    connection.set(FAILED + name, said, ex=None if set_aside else FAILURE_TTL_S)
    return Failure(said, times, set_aside)


def forget_failures(connection: Redis, *, set_aside: bool) -> None:
    """Have failed jobs queued again; those that are set aside only if asked to, which then begin anew."""
    names = sorted(failed_names(connection))
    ttls = _ttls(connection, names)
    for some in batches([name for name in names if set_aside or ttls[name] >= 0]):
        prefixes = (FAILED, STARTS, OVERDUE, *([FAILURES] if set_aside else []))
        connection.delete(*(prefix + name for prefix in prefixes for name in some))


def forget_failures_of(connection: Redis, name: str) -> None:
    """Forget what was counted against a job, which has ended well."""
    connection.delete(STARTS + name, OVERDUE + name, FAILURES + name, FAILED + name)


def forget_starts_of(connection: Redis, name: str) -> None:
    """Count nothing against a job that has ended, but its failures."""
    connection.delete(STARTS + name, OVERDUE + name)


def count_start(connection: Redis, name: str) -> int:
    """Count a start of a job, until it ends; how many there were."""
    return _count(connection, STARTS + name)


def count_overdue(connection: Redis, name: str) -> int:
    """Count a start of a job that the deadline has ended; how many there were."""
    return _count(connection, OVERDUE + name)


def overdue(connection: Redis, name: str) -> int:
    """How many of a job's starts the deadline has ended."""
    (times,) = beginnings(connection, [OVERDUE + name], 10)
    return int(times) if times.isdecimal() and times.isascii() else 0


def _count(connection: Redis, key: str) -> int:
    remove_others(connection, {key: "counter"})
    times = int(connection.incr(key))
    connection.expire(key, STARTS_TTL_S)
    return times


def failed_names(connection: Redis) -> set[str]:
    """The jobs that are not to be queued, since they failed lately or too often."""
    return {name for name in names_below(connection, FAILED) if _is_a_jobs(name)}


def read_failures(connection: Redis) -> dict[str, Failure]:
    """The failed jobs by name."""
    names = sorted(failed_names(connection))
    reasons = beginnings(connection, [FAILED + name for name in names], 4 * REASON_LETTERS)
    counts = beginnings(connection, [FAILURES + name for name in names], 20)
    ttls = _ttls(connection, names)
    return {
        name: Failure(
            printable(reason[:REASON_LETTERS]), int(times) if times.isdecimal() else 1, set_aside=ttls[name] == -1
        )
        for name, reason, times in zip(names, reasons, counts, strict=True)
        if ttls[name] != -2  # it has not just run out
    }


def _ttls(connection: Redis, names: Sequence[str]) -> dict[str, int]:
    """For how many seconds failures are remembered yet: -1 for good, -2 no longer."""
    found: list[int] = []
    for some in batches(names):
        with connection.pipeline(transaction=False) as pipeline:
            for name in some:
                pipeline.ttl(FAILED + name)
            found += pipeline.execute()
    return dict(zip(names, found, strict=True))


def causes(failures: Mapping[str, Failure]) -> list[Cause]:
    """Failures by their cause, the most frequent first."""
    grouped: dict[str, dict[str, Failure]] = {}
    for name, failure in sorted(failures.items(), key=lambda item: (not item[1].set_aside, item[0])):
        grouped.setdefault(_VARYING.sub("…", failure.reason), {})[name] = failure
    found = [Cause(cause, sum(f.set_aside for f in jobs.values()), jobs) for cause, jobs in grouped.items()]
    return sorted(found, key=lambda cause: -len(cause.jobs))


def repeating_command(store: str | Path, name: str) -> str:
    """What renders a job again in the foreground, and prints its error whole."""
    job = RenderArguments.of(name)
    return shlex.join(["photonfarm", "work", "--store", str(store), "--scene", job.scene_id, "--job", str(job.job)])


def _is_a_jobs(name: str) -> bool:
    try:
        RenderArguments.of(name)
    except QueueError:
        return False
    return True
