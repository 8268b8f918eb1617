"""Failures that outlive Redis: a small file in the store for each, written once.

For people, who ask later why a job is missing; and for workers without Redis, who try a failed job as often as the
queue does, and then leave it alone until `submit --retry`, of which a file beside the failures tells. All times are
those of the writers' clocks, so these must agree to within minutes.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable

from photonfarm.shared.queue.failures import Failure, one_line
from photonfarm.shared.queue.job import is_job_name
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import put_json
from photonfarm.shared.store.write.store import FAILURES_FOLDER

_FILE = re.compile(r"(.+)\.([0-9]{1,16})\.json")

RETRIED = "retried"
"""The name of a file that forgets the failures before it."""


def keep_failure(store: Store, name: str, reason: str, *, worker: str) -> None:
    """Keep why a job failed just now. Raises OSError if the store refuses."""
    _keep(store, name, {"job": name, "reason": one_line(reason), "worker": worker})


def keep_retry(store: Store) -> None:
    """Keep that all failed jobs are to be tried again, if any failure is kept. Raises OSError if the store refuses."""
    if store.storage.names(FAILURES_FOLDER):
        _keep(store, RETRIED, {})


def _keep(store: Store, name: str, document: dict[str, str]) -> None:
    at_ms = time.time_ns() // 1_000_000
    put_json(store.storage, {**document, "at_s": at_ms / 1000}, f"{FAILURES_FOLDER}/{name}.{at_ms}.json")


def kept_failures(store: Store, wanted: Callable[[str], bool] = lambda _: True) -> dict[str, Failure]:
    """The last kept failure of each of the `wanted` jobs since all were retried, by its name.

    Raises OSError if the store cannot be read.
    """
    return {
        name: Failure(_reason(store, name, max(times_ms)), len(times_ms))
        for name, times_ms in sorted(_times_ms(store).items())
        if wanted(name)
    }


def times_failed(store: Store) -> dict[str, int]:
    """How often each job has failed since all were retried, by its name, for one listing. Raises OSError."""
    return {name: len(times_ms) for name, times_ms in _times_ms(store).items()}


def _times_ms(store: Store) -> dict[str, list[int]]:
    """When jobs failed, in milliseconds since 1970, as the names of the files tell."""
    named = [found for file in store.storage.names(FAILURES_FOLDER) if (found := _FILE.fullmatch(file))]
    retried = max((int(found[2]) for found in named if found[1] == RETRIED), default=-1)
    failed: dict[str, list[int]] = {}
    for found in named:
        if is_job_name(found[1]) and int(found[2]) > retried:
            failed.setdefault(found[1], []).append(int(found[2]))
    return failed


def _reason(store: Store, name: str, at_ms: int) -> str:
    try:
        return one_line(json.loads(store.storage.read(f"{FAILURES_FOLDER}/{name}.{at_ms}.json"))["reason"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "the record of the failure cannot be read"
