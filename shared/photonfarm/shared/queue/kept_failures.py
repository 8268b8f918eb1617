"""Failures that outlive Redis: a small file in the store for each, written once.

For people, who ask later why a job is missing; and for workers without Redis, who leave a failed job alone by the same
rule as Redis keeps: for an hour or until the next submission, and for good after FAILURES_ALLOWED failures, until
`submit --retry`. Files beside the failures say when there were such submissions. All times are those of the writers'
clocks, so these must agree to within minutes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from photonfarm.shared.queue.failures import FAILURES_ALLOWED, REASON_LETTERS, Failure
from photonfarm.shared.queue.job import FAILURE_TTL_S, is_job_name
from photonfarm.shared.queue.untrusted import printable
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import put_json
from photonfarm.shared.store.write.store import FAILURES_FOLDER

_FILE = re.compile(r"(.+)\.([0-9]{1,16})\.json")

SUBMITTED, RETRIED = "submitted", "retried"
"""The names of files that forget failures: those of jobs that are not set aside, or all."""


def keep_failure(store: Store, name: str, reason: str, *, worker: str, at_s: float) -> None:
    """Keep why a job failed, at `at_s` seconds since 1970. Raises OSError if the store refuses."""
    document = {"job": name, "reason": reason[:REASON_LETTERS], "worker": worker, "at_s": round(at_s, 3)}
    put_json(store.storage, document, f"{FAILURES_FOLDER}/{name}.{int(1000 * at_s)}.json")


def keep_submission(store: Store, *, retry: bool, at_s: float) -> None:
    """Keep that failed jobs were submitted again, with `retry` also those that were set aside.

    Nothing is written while no failure is kept. Raises OSError if the store refuses.
    """
    if store.storage.names(FAILURES_FOLDER):
        name = RETRIED if retry else SUBMITTED
        put_json(store.storage, {"at_s": round(at_s, 3)}, f"{FAILURES_FOLDER}/{name}.{int(1000 * at_s)}.json")


@dataclass(frozen=True, slots=True)
class _Times:
    """What the names of all files say: when, in milliseconds since 1970."""

    failed: dict[str, list[int]] = field(default_factory=dict)  # by job
    submitted: int = -1
    retried: int = -1

    @classmethod
    def of(cls, files: Iterable[str]) -> _Times:
        failed: dict[str, list[int]] = {}
        again = {SUBMITTED: -1, RETRIED: -1}
        for file in files:
            if not (found := _FILE.fullmatch(file)):
                continue
            name, at_ms = found[1], int(found[2])
            if name in again:
                again[name] = max(again[name], at_ms)
            elif is_job_name(name):
                failed.setdefault(name, []).append(at_ms)
        return cls(failed, again[SUBMITTED], again[RETRIED])

    def are_left(self, name: str, now_ms: float) -> bool:
        """Whether a job is left alone."""
        counted = [at_ms for at_ms in self.failed[name] if at_ms > self.retried]
        if len(counted) >= FAILURES_ALLOWED:
            return True
        return bool(counted) and self.submitted < max(counted) and now_ms - max(counted) < 1000 * FAILURE_TTL_S


def jobs_left_alone(store: Store, now_s: float) -> set[str]:
    """The jobs that workers without Redis leave alone for now, by the failures that are kept; costs one listing.

    `now_s` is the time in seconds since 1970. Raises OSError if the store cannot be read.
    """
    times = _Times.of(store.storage.names(FAILURES_FOLDER))
    return {name for name in times.failed if times.are_left(name, 1000 * now_s)}


def kept_failures(store: Store, wanted: Callable[[str], bool]) -> dict[str, Failure]:
    """The last kept failure of each of the `wanted` jobs, by its name. Raises OSError if the store cannot be read."""
    by_job = _Times.of(store.storage.names(FAILURES_FOLDER)).failed
    return {name: _read(store, name, times_ms) for name, times_ms in sorted(by_job.items()) if wanted(name)}


def _read(store: Store, name: str, times_ms: list[int]) -> Failure:
    """The last of a job's failures; one whose file is damaged has no reason."""
    try:
        document = json.loads(store.storage.read(f"{FAILURES_FOLDER}/{name}.{max(times_ms)}.json"))
        reason = str(document["reason"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        reason = "the record of the failure cannot be read"
    return Failure(printable(reason[:REASON_LETTERS]), len(times_ms), set_aside=False)
