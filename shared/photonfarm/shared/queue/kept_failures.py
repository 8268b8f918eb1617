"""Failures that outlive Redis: a small file in the store for each, written once.

Redis decides which jobs are queued; these are for people, who ask later why a job is missing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable

from photonfarm.shared.queue.failures import REASON_LETTERS, Failure
from photonfarm.shared.queue.job import is_job_name
from photonfarm.shared.queue.untrusted import printable
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import put_json
from photonfarm.shared.store.write.store import FAILURES_FOLDER

_FILE = re.compile(r"(.+)\.([0-9]{1,16})\.json")


def keep_failure(store: Store, name: str, reason: str, *, worker: str, at_s: float) -> None:
    """Keep why a job failed, at `at_s` seconds since 1970. Raises OSError if the store refuses."""
    document = {"job": name, "reason": reason[:REASON_LETTERS], "worker": worker, "at_s": round(at_s, 3)}
    put_json(store.storage, document, f"{FAILURES_FOLDER}/{name}.{int(1000 * at_s)}.json")


def kept_failures(store: Store, wanted: Callable[[str], bool]) -> dict[str, Failure]:
    """The last kept failure of each of the `wanted` jobs, by its name. Raises OSError if the store cannot be read."""
    by_job: dict[str, list[int]] = {}
    for file in store.storage.names(FAILURES_FOLDER):
        if (found := _FILE.fullmatch(file)) and is_job_name(found[1]):
            by_job.setdefault(found[1], []).append(int(found[2]))
    return {name: _read(store, name, times_ms) for name, times_ms in sorted(by_job.items()) if wanted(name)}


def _read(store: Store, name: str, times_ms: list[int]) -> Failure:
    """The last of a job's failures; one whose file is damaged has no reason."""
    try:
        document = json.loads(store.storage.read(f"{FAILURES_FOLDER}/{name}.{max(times_ms)}.json"))
        reason = str(document["reason"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        reason = "the record of the failure cannot be read"
    return Failure(printable(reason[:REASON_LETTERS]), len(times_ms), set_aside=False)
