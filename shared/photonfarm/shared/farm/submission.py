"""Plan and queue samples, given a spec and a few numbers."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from photonfarm.shared import queue
from photonfarm.shared.core.errors import QueueError, SpecError, store_errors
from photonfarm.shared.core.models import differing
from photonfarm.shared.farm.job_size import WORKERS, rows_per_job
from photonfarm.shared.plan.request import Request
from photonfarm.shared.plan.top_up import TopUp, spp_per_pass
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.spec_loading import NamedSpec
from photonfarm.shared.store import Store
from photonfarm.shared.store.read.find import scene_named
from photonfarm.shared.store.read.other_scenes import first_plan_note, other_scenes, with_same_radiance
from photonfarm.shared.store.write.lease import at_work

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Submission:
    """The outcome of a request."""

    scene_id: str
    plan: int | None  # number of the new plan; None if nothing was new or nothing was written
    planned: int  # samples planned by this request
    planned_before: int  # samples of the request that older plans hold
    queued: int | None  # jobs queued, also those of older plans that were missing; None: not queued
    dry_run: bool = False  # nothing was written
    note: str | None = None  # that the store has another scene of this name, and how it differs
    halves_from: str | None = None  # the scene whose halves jobs take over
    replaced: str | None = None  # what of the stored spec this one has replaced, in words
    scenes: str | None = None  # folder that workers must have in PHOTONFARM_SCENES to find the scene file, if any must


@dataclass(frozen=True, slots=True)
class TopUpSubmission(Submission):
    """The outcome of a top-up."""

    spp_per_pass: int = field(kw_only=True)  # samples per pixel of one pass, both halves together
    passes: int = field(kw_only=True)  # the requested samples per pixel as passes, rounded up


def submit(
    named: NamedSpec,
    store: str | Path,
    redis_url: str | None,
    request: Request,
    *,
    retry: bool = False,
    shard_rows: int | None = None,
    workers: int = WORKERS,
    halves_from: str | None = None,
) -> Submission:
    """Plan the new samples of a request, and queue every missing job of the store unless `redis_url` is None.

    Without `shard_rows`, a scene's first request gets jobs of some seconds, several for each of the `workers`.
    `halves_from` is a scene of the store by its id or how it begins: jobs take over the halves it has. Without it, that
    is the scene of the same radiance with most of them, if there is one.
    With `retry` also jobs that were set aside. While somebody has the scene for itself, this waits and says so. Raises
    SpecError, StoreError, or QueueError; in the last case the plan is kept, and idle workers queue it later.
    """
    opened = Store(store, create=True)
    usual = rows_per_job(named.spec, request, workers)
    other = scene_named(opened, halves_from) if halves_from else with_same_radiance(opened, named.spec)
    before = opened.scene(named.spec.scene_id).spec if opened.has_scene(named.spec.scene_id) else None
    with at_work(opened.storage, named.spec.scene_id, "submit", log.warning):
        planned = opened.plan(named.spec, request, shard_rows=shard_rows, usual_rows=usual, halves_from=other)
    anew = planned.scene_id if planned.plan == 0 else False  # a scene of this id may have been forgotten
    queued = _queued(opened, redis_url, retry=retry or anew)
    return Submission(
        planned.scene_id, planned.plan, planned.new, planned.known, queued,
        note=first_plan_note(opened, named.spec) if planned.plan == 0 else None,
        halves_from=other if planned.new else None,
        replaced=None if before is None else _replaced(before, named.spec),
        scenes=named.scenes,
    )  # fmt: skip


def _replaced(there: SceneSpec, here: SceneSpec) -> str | None:
    """What a stored spec has lost to a submitted one of the same ids, in words; None if they agree."""
    then, now = (spec.model_dump(mode="json", exclude={"scene", "stored_exponent"}) for spec in (there, here))
    changes = differing(then, now)
    return ", ".join(f"{key} ({was} before, {is_} now)" for key, (was, is_) in changes.items()) or None


def top_up(
    named: NamedSpec,
    store: str | Path,
    redis_url: str | None,
    spp: str,
    *,
    where: Sequence[str] = (),
    retry: bool = False,
    dry_run: bool = False,
) -> TopUpSubmission:
    """Plan more passes of planned views, and queue every missing job of the store unless `redis_url` is None.

    `spp` and `where` are as `TopUp.of` takes them. Raises what `submit` does.
    """
    scene_id, wanted = named.spec.scene_id, TopUp.of(spp, where)
    opened = Store(store)
    if scene_id not in opened.scene_ids():
        raise SpecError(
            f"{named.name}: {store} has no samples of scene {scene_id} that could be topped up; "
            f"{other_scenes(opened, named.spec)}; `photonfarm submit` plans the first ones"
        )
    with at_work(opened.storage, scene_id, "top-up", log.warning):
        planned = opened.scene(scene_id).plan(wanted, dry_run=dry_run)
    queued = None if dry_run else _queued(opened, redis_url, retry=retry)
    return TopUpSubmission(
        planned.scene_id,
        planned.plan,
        planned.new,
        planned.known,
        queued,
        dry_run,
        spp_per_pass=spp_per_pass(named.spec),
        passes=wanted.passes(named.spec),
    )


def _queued(store: Store, redis_url: str | None, *, retry: bool | str) -> int | None:
    """The number of jobs that are queued now; None without Redis. Workers that have none learn it from the store."""
    if retry is True:
        with store_errors("note a retry", store.storage.where):
            queue.keep_retry(store)
    return None if redis_url is None else queue_missing(store, redis_url, retry=retry)


def queue_missing(
    store: Store,
    redis_url: str,
    *,
    scene_id: str | None = None,
    retry: bool | str = False,
    stored: str = "The plan is stored",
    verb: str = "submits",
) -> int:
    """Queue every missing job of a store, or of one scene; returns how many.

    With `retry` also jobs that were set aside. Raises QueueError; its message says what
    is `stored` nevertheless, and that --no-queue {verb} without Redis.
    """
    try:
        connection = queue.connect(redis_url)
        return queue.reconcile(store, connection, scene_id=scene_id, retry=retry)
    except queue.OtherStoreError as error:
        raise QueueError(f"{error}. {stored} in {store.storage.where}") from error
    except QueueError as error:
        raise QueueError(
            f"{str(error).rstrip('.')}. {stored}, and idle workers will find it; --no-queue {verb} without Redis"
        ) from error
