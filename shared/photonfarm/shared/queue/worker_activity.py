"""What workers are doing, as they report it: which part of a job, and how far it is.

A report is written every few seconds and expires soon after. It is text for people: no decision depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from redis import Redis

from photonfarm.shared.queue.job import MAX_NAME, is_job_name
from photonfarm.shared.queue.untrusted import beginnings, names_below, printable

DOING = "rq:photonfarm:doing:"
PHASE_LETTERS = 60
_VALUE_BYTES = 4 * PHASE_LETTERS + MAX_NAME + 32


@dataclass(frozen=True, slots=True)
class Activity:
    """What a worker is doing; printable."""

    phase: str  # such as "renders samples"
    done: int = 0  # samples of its job that are rendered, and not committed yet
    total: int = 0  # of so many; 0: the phase has no parts
    job: str | None = None  # its name

    def __str__(self) -> str:
        """The activity in words."""
        return f"{self.phase} {self.done}/{self.total}" if self.total else self.phase


def report_activity(connection: Redis, worker: str, activity: Activity, *, ttl_s: float) -> None:
    """Report what a worker is doing; expires after `ttl_s`."""
    value = f"{activity.done} {activity.total} {activity.job or '-'} {activity.phase[:PHASE_LETTERS]}"
    connection.set(DOING + worker, value, px=int(ttl_s * 1000))


def clear_activity(connection: Redis, worker: str) -> None:
    """Remove a worker's report."""
    connection.delete(DOING + worker)


def read_activities(connection: Redis) -> Mapping[str, Activity]:
    """The activities that workers have reported, by their names."""
    names = sorted(names_below(connection, DOING))
    values = beginnings(connection, [DOING + name for name in names], _VALUE_BYTES)
    found = {printable(name): _parsed(value) for name, value in zip(names, values, strict=True)}
    return {name: activity for name, activity in found.items() if activity is not None}


def _parsed(value: str) -> Activity | None:
    words = value.split(" ", 3)
    if len(words) != 4 or not all(word.isascii() and word.isdecimal() and len(word) <= 6 for word in words[:2]):
        return None
    job = words[2] if is_job_name(words[2]) else None
    return Activity(printable(words[3])[:PHASE_LETTERS], int(words[0]), int(words[1]), job)
