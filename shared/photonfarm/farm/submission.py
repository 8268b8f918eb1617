"""`submit` and `top-up` plan and queue samples, given a spec and a few numbers; a first request sizes the jobs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from photonfarm.core.errors import QueueError, SpecError, store_errors
from photonfarm.core.formatting import format_count
from photonfarm.core.models import differing
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import SHARD_ROWS, Request
from photonfarm.plan.top_up import TopUp, spp_per_pass
from photonfarm.queue.connection import connect
from photonfarm.queue.failures import keep_retry
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.workers import OtherStoreError
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import PlanResult, Store
from photonfarm.store.model.lease import announce_work
from photonfarm.store.model.scene_store import stored_spec
from photonfarm.store.read.find import describe_scenes, find_same_radiance, note_first_plan, scene_named

WORKERS = 8
"""The workers that a plan is made for where their number is not known."""

JOBS_EACH = 4
"""The jobs that each worker should have at least, so that none idles for long while others render the last ones."""

MOST_S = 10.0
"""The longest that a job should take, in seconds of a core or a card."""

LEAST_S = 2.0
"""The shortest, whatever JOBS_EACH says: a scene's jobs are all of one size, and large plans may follow a small one."""

SAMPLE_S = 0.1
"""The estimated core-seconds of a sample, whatever its size: its buffers, its photons and its files."""

PATHS_PER_S = 250_000.0
"""The estimated eye paths, of up to DEPTH segments, that a core traces in a second."""

DEPTH = 8

CARD_SAMPLE_S, CARD_PATHS_PER_S = 0.05, 20_000_000.0
"""The same of a card: an H200, whose samples took 20 to 80 ms beside 17 to 25 million paths a second of bdpt."""

CARD_ROWS = 64
"""The most samples of a job for a card: of a small image as many as this fill it together."""


def estimate_sample_seconds(spec: SceneSpec, *, on_card: bool = False) -> float:
    """The estimated seconds of a core, or a card, for a sample; of real rooms they are up to three times more or less.

    Without `on_card` a core renders.
    """
    film, transport = spec.film, spec.transport
    each_s, paths_per_s = (CARD_SAMPLE_S, CARD_PATHS_PER_S) if on_card else (SAMPLE_S, PATHS_PER_S)
    paths = film.width * film.height * 2 * transport.half_spp  # of both halves
    return each_s + paths * max(transport.max_depth, 1) / DEPTH / paths_per_s


def choose_rows_per_job(
    spec: SceneSpec, request: Request | Chosen, workers: int = WORKERS, *, on_card: bool = False
) -> int:
    """The samples of a job for a scene whose first request this is: some seconds of work, and several jobs a worker.

    Jobs of many seconds keep workers idle at the end, and show nothing for long; jobs of less than a second cost more
    than they render, in files and markers. Cards render what takes cores minutes in seconds, so jobs for them have more
    samples.
    """
    sample_s = estimate_sample_seconds(spec, on_card=on_card)
    shared_out = max(request.samples // (workers * JOBS_EACH), round(LEAST_S / sample_s))
    rows = max(1, min(shared_out, round(MOST_S / sample_s), CARD_ROWS if on_card else SHARD_ROWS))
    of_configuration = request.views_per_modification * request.passes
    return rows - rows % of_configuration if rows > of_configuration else rows  # so that photons are rendered once


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
    request: Request | Chosen,
    *,
    retry: bool = False,
    shard_rows: int | None = None,
    workers: int = WORKERS,
    on_card: bool = False,
    halves_from: str | None = None,
) -> Submission:
    """Plan the new samples of a request, and queue every missing job of the store unless `redis_url` is None.

    Without `shard_rows`, a scene's first request gets jobs of some seconds, several for each of the `workers`,
    which render `on_card` or on cores.
    `halves_from` is a scene of the store by its id or how it begins: jobs take over the halves it has. Without it, that
    is the scene of the same radiance with most of them, if there is one.
    With `retry` also jobs that were set aside. While somebody has the scene for itself, this waits and says so. Raises
    SpecError, StoreError, or QueueError; in the last case the plan is kept, and idle workers queue it later.
    """
    opened = Store(store, create=True)
    usual = choose_rows_per_job(named.spec, request, workers, on_card=on_card)
    other = scene_named(opened, halves_from) if halves_from else find_same_radiance(opened, named.spec)
    before = stored_spec(opened.storage, named.spec.scene_id)
    replaced = None if before is None else _describe_replaced(before, named.spec)
    with announce_work(opened.storage, named.spec.scene_id, "submit", log.warning):
        planned = opened.plan(named.spec, request, shard_rows=shard_rows, usual_rows=usual, halves_from=other)
    # a first plan's scene may have been here, with failed jobs of the same names, and forgotten
    retry_scene = planned.scene_id if planned.plan == 0 else False
    queued = _queue(opened, redis_url, planned, retry=retry or retry_scene)
    return Submission(
        planned.scene_id,
        planned.plan,
        planned.new,
        planned.known,
        queued,
        note=note_first_plan(opened, named.spec) if planned.plan == 0 else None,
        halves_from=other if planned.new else None,
        replaced=replaced,
        scenes=named.scenes,
    )


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
            f"{describe_scenes(opened, named.spec)}; `photonfarm submit` plans the first ones"
        )
    with announce_work(opened.storage, scene_id, "top-up", log.warning):
        planned = opened.scene(scene_id).plan(wanted, dry_run=dry_run)
    queued = None if dry_run else _queue(opened, redis_url, planned, retry=retry)
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


def _describe_replaced(before: SceneSpec, now: SceneSpec) -> str | None:
    """What of a stored spec another one of the same scene replaces, in words; None if nothing."""
    old, new = (each.model_dump(mode="json", exclude={"scene", "stored_exponent"}) for each in (before, now))
    return ", ".join(f"{key} ({was} before, {is_} now)" for key, (was, is_) in differing(old, new).items()) or None


def _queue(store: Store, redis_url: str | None, planned: PlanResult, *, retry: bool | str) -> int | None:
    """Queue every missing job; returns how many, None without Redis. The store notes a retry for workers without it.

    A QueueError says what is planned all the same.
    """
    if retry is True:
        with store_errors("note a retry", store.storage.where):
            keep_retry(store)
    try:
        return None if redis_url is None else queue_missing(store, redis_url, retry=retry)
    except QueueError as error:
        done = f"{format_count(planned.new, 'sample')} planned, {planned.known} planned before, and not queued"
        raise QueueError(f"{done}: {error}") from error


def queue_missing(store: Store, redis_url: str, *, retry: bool | str = False) -> int:
    """Queue every missing job of a store; returns how many.

    With `retry`, as `reconcile` takes it, also what was set aside. A QueueError says that the plan is stored anyway.
    """
    try:
        connection = connect(redis_url)
        return reconcile(store, connection, retry=retry)
    except OtherStoreError as error:
        raise QueueError(f"{error}. The plan is stored in {store.storage.where}") from error
    except QueueError as error:
        how = "The plan is stored; `photonfarm work --share 0/1` renders it without a Redis"
        raise QueueError(f"{str(error).rstrip('.')}. {how}") from error
