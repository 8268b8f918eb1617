"""Jobs that failed: why, how often, which are set aside, and what they have in common.

A failed job is not queued for an hour and then tried again; one that has failed three times is set aside, until
`photonfarm submit --retry`. A Redis that loses its data forgets this as well: the job then fails three times again.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from redis import Redis

from photonfarm.shared.queue.job import FAILURE_TTL_S, OVERDUE, STARTS, RenderArguments, is_job_name
from photonfarm.shared.queue.untrusted import batches, beginnings, names_below, printable, remove_others

FAILED = "rq:photonfarm:failed:"
FAILURES = "rq:photonfarm:failures:"

FAILURES_ALLOWED = 3
"""The failures of one job after which it is set aside: so many are no accident of one worker or one hour."""

FAILURES_TTL_S = 7 * 86400
STARTS_TTL_S = 6 * 3600
REASON_LETTERS = 2000

_VARYING = re.compile(r"\b[0-9a-f]{8,}\b|[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
"""The parts of a message that differ between failures of one cause: ids and numbers."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a job is not queued now."""

    reason: str  # the error's class and message
    times: int  # how often it has failed
    set_aside: bool  # False: it is tried again within the hour


@dataclass(frozen=True, slots=True)
class FailureCause:
    """Failures whose error and message are the same but for ids and numbers."""

    cause: str  # the message with … for what differs
    set_aside: int
    jobs: dict[str, Failure]  # by name, those set aside first

    @property
    def example(self) -> str:
        """The name of one of the jobs."""
        return next(iter(self.jobs))


def record_failure(connection: Redis, name: str, reason: str) -> Failure:
    """Record why a job failed: it is not queued for an hour, or for good once it has failed too often."""
    remove_others(connection, {FAILURES + name: "counter"})
    times = int(connection.incr(FAILURES + name))
    connection.expire(FAILURES + name, FAILURES_TTL_S)
    set_aside = times >= FAILURES_ALLOWED
    text = printable(reason[:REASON_LETTERS])
    connection.set(FAILED + name, text, ex=None if set_aside else FAILURE_TTL_S)
    return Failure(text, times, set_aside)


def forget_failures(connection: Redis, *, set_aside: bool) -> None:
    """Let failed jobs be queued again; with `set_aside` also those that were set aside, counted from 0 again."""
    names = sorted(failed_names(connection))
    ttls = _ttls(connection, names)
    for some in batches([name for name in names if set_aside or ttls[name] >= 0]):
        prefixes = (FAILED, STARTS, OVERDUE, *([FAILURES] if set_aside else []))
        connection.delete(*(prefix + name for prefix in prefixes for name in some))


def forget_failures_of(connection: Redis, name: str) -> None:
    """Reset all counts of a job, which has succeeded."""
    connection.delete(STARTS + name, OVERDUE + name, FAILURES + name, FAILED + name)


def forget_starts_of(connection: Redis, name: str) -> None:
    """Reset the counts of a job's starts, which has ended; its failures stay."""
    connection.delete(STARTS + name, OVERDUE + name)


def count_start(connection: Redis, name: str) -> int:
    """Count a start of a job; returns the starts since the job last ended."""
    return _count(connection, STARTS + name)


def count_overdue(connection: Redis, name: str) -> int:
    """Count a start of a job that the deadline has ended; returns their number."""
    return _count(connection, OVERDUE + name)


def overdue(connection: Redis, name: str) -> int:
    """The number of a job's starts that the deadline has ended."""
    (times,) = beginnings(connection, [OVERDUE + name], 10)
    return int(times) if times.isdecimal() and times.isascii() else 0


def _count(connection: Redis, key: str) -> int:
    remove_others(connection, {key: "counter"})
    times = int(connection.incr(key))
    connection.expire(key, STARTS_TTL_S)
    return times


def failed_names(connection: Redis) -> set[str]:
    """The jobs that are not queued, since they failed recently or too often."""
    return {name for name in names_below(connection, FAILED) if is_job_name(name)}


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
    """The seconds for which each failure is still remembered: -1 for ever, -2 no longer."""
    found: list[int] = []
    for some in batches(names):
        with connection.pipeline(transaction=False) as pipeline:
            for name in some:
                pipeline.ttl(FAILED + name)
            found += pipeline.execute()
    return dict(zip(names, found, strict=True))


def causes(failures: Mapping[str, Failure]) -> list[FailureCause]:
    """Failures by their cause, the most frequent first."""
    grouped: dict[str, dict[str, Failure]] = {}
    for name, failure in sorted(failures.items(), key=lambda item: (not item[1].set_aside, item[0])):
        grouped.setdefault(_VARYING.sub("…", failure.reason), {})[name] = failure
    found = [FailureCause(cause, sum(f.set_aside for f in jobs.values()), jobs) for cause, jobs in grouped.items()]
    return sorted(found, key=lambda cause: -len(cause.jobs))


def repeating_command(store: str | Path, name: str) -> str:
    """The command that renders a job again in the foreground, and prints its whole error."""
    job = RenderArguments.of(name)
    return shlex.join(["photonfarm", "work", "--store", str(store), "--scene", job.scene_id, "--job", str(job.job)])
