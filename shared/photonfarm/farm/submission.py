"""`submit` and `top-up`: plan and queue samples, given a spec and a few numbers.

Before anything is planned: whether a request leaves something to train on and something to validate on, and how many
samples a job has.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from photonfarm.core.errors import QueueError, SpecError, StoreError, store_errors
from photonfarm.core.formatting import format_count
from photonfarm.core.keys import Key
from photonfarm.core.models import differing
from photonfarm.plan.hold_out import HOLD_OUT, are_held_out, enough, units_of
from photonfarm.plan.request import SHARD_ROWS, PlannedContent, Request, expand
from photonfarm.plan.top_up import PlannedViews, TopUp, spp_per_pass
from photonfarm.queue.connection import connect
from photonfarm.queue.failures import keep_retry
from photonfarm.queue.reconciliation import reconcile
from photonfarm.queue.workers import OtherStoreError
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.model.lease import announce_work
from photonfarm.store.model.plans import StoredPlan, content, load_all
from photonfarm.store.model.scene_store import SCENES, stored_spec
from photonfarm.store.read.find import describe_scenes, find_same_radiance, note_first_plan, scene_named

MOST_NAMED = 4096
"""The largest number of configurations that a message proposes."""

PLENTY = 256
"""So many configurations are split by the default share, but for one case in 10^14; more are not looked at."""


def check_hold_out(spec: SceneSpec, store: str | Path, share: float, request: Request) -> None:
    """Raise SpecError if nothing or everything of what is planned and requested would be held out.

    Nothing is written. The message names numbers that would do. The trainer checks the same, but only after everything
    is rendered.
    """
    if fault := _find_fault(spec, _read_plans(spec, store), share, request):
        raise SpecError(fault)


def choose_hold_out(spec: SceneSpec, store: str | Path, request: Request) -> float:
    """The share to hold out where a user names none: the default, or just enough for one of what a small plan has.

    Raises SpecError if there is only one configuration (in a static scene, view).
    """
    plans = _read_plans(spec, store)
    keys = _list_units(spec, plans, request)
    share = enough(keys) or enough(keys, least=0.0)
    if share is None:
        more = _least(request, lambda wanted: enough(_list_units(spec, plans, wanted)) is not None)
        remedy = f"--modifications {more} plans enough" if more else "the spec has no other, as nothing in it varies"
        kind = "configuration" if spec.groups else "view"
        raise SpecError(f"{len(keys)} {kind} is planned: one to train on and one to validate on are needed; {remedy}")
    return share


def hold_out_warning(spec: SceneSpec, store: str | Path, request: Request) -> str | None:
    """Why `train` with the default share would refuse what is planned and requested; None if it would not.

    A store that cannot be read is left to those who write into it.
    """
    few = request.model_copy(update={"modifications": min(request.modifications, PLENTY)})
    if _find_fault(spec, [], HOLD_OUT, few) is None:
        return None  # whatever else is planned, which may be much
    with suppress(StoreError):
        if fault := _find_fault(spec, _read_plans(spec, store), HOLD_OUT, few):
            return f"`photonfarm train` will refuse this: {fault}"
    return None


def _find_fault(spec: SceneSpec, plans: list[StoredPlan], share: float, request: Request) -> str | None:
    """What is wrong with a share for what is planned and requested, and the numbers that would do, in words."""

    def splits(wanted: Request) -> bool:
        return len(set(are_held_out(_list_units(spec, plans, wanted), share))) == 2

    if splits(request):
        return None
    keys, remedies = _list_units(spec, plans, request), []
    if (other := enough(keys, least=0.0)) is not None:
        remedies.append(f"--hold-out {other:g} holds out one of these")
    if more := _least(request, splits):
        remedies.append(f"--modifications {more} plans enough")
    all_are = any(are_held_out(keys, share))
    which = "all are held out, and none is left to train on" if all_are else "none is held out, and one is needed"
    of = f"of the {format_count(len(keys), 'configuration' if spec.groups else 'view')} planned"
    return f"hold_out = {share:g}: {of} {which}; {', and '.join(remedies) or 'plan more, or use another --hold-out'}"


def _least(request: Request, works: Callable[[Request], bool]) -> int | None:
    """The least number of configurations from the request's on that works, as more of them then do; None: not found."""
    among = range(MOST_NAMED)

    def of(modifications: int) -> bool:
        return works(request.model_copy(update={"modifications": modifications}))

    place = bisect_left(among, True, lo=min(request.modifications, MOST_NAMED), key=of)
    return place if place < MOST_NAMED else None


def _list_units(spec: SceneSpec, plans: list[StoredPlan], request: Request) -> set[Key]:
    """What is held out as one, of all that is planned and requested: configurations, or a static scene's views."""
    wanted = request.model_copy(update={"passes": 1})
    if spec.groups:
        wanted = wanted.model_copy(update={"views_per_modification": 1})  # the configuration alone decides
    known = content(plans)
    first_job, shard_rows = (plans[-1].end_job, plans[0].shard_rows) if plans else (0, SHARD_ROWS)
    new = expand(spec, wanted, known, first_job=first_job, shard_rows=shard_rows).rows
    more = [] if new is None else [(first_job * shard_rows, new)]
    views = PlannedViews.of(spec, PlannedContent([*known.plans, *more]))
    return set(units_of(views, np.arange(len(views.view_row))))


def _read_plans(spec: SceneSpec, store: str | Path) -> list[StoredPlan]:
    """The plans of a scene; none if the store does not have it."""
    return [] if is_vacant(store) else load_all(Store(store).storage, f"{SCENES}/{spec.scene_id}", [])


WORKERS = 8
"""The workers that a plan is made for where their number is not known."""

JOBS_EACH = 4
"""The least jobs of each worker, so that none idles for long while others render the last ones."""

MOST_S = 10.0
"""The longest that a job should take."""

LEAST_S = 2.0
"""The shortest: a small first plan may be followed by large ones, whose jobs are as small."""

SAMPLE_S = 0.1
"""The estimated core-seconds of a sample, whatever its size: its buffers, its photons and its files."""

PATHS_PER_S = 250_000.0
"""The estimated eye paths that a core traces in a second, of DEPTH segments."""

DEPTH = 8


def sample_seconds(spec: SceneSpec) -> float:
    """The estimated core-seconds of a sample; rooms differ from it by a factor of three either way."""
    film, transport = spec.film, spec.transport
    paths = film.width * film.height * 2 * transport.half_spp
    return SAMPLE_S + paths * max(transport.max_depth, 1) / DEPTH / PATHS_PER_S


def rows_per_job(spec: SceneSpec, request: Request, workers: int = WORKERS) -> int:
    """The samples of a job for a scene whose first request this is: some seconds of work, and several jobs a worker.

    Jobs of many seconds keep workers idle at the end, and show nothing for long; jobs of less than a second cost more
    than they render, in files and markers.
    """
    each = sample_seconds(spec)
    shared_out = max(request.samples // (workers * JOBS_EACH), round(LEAST_S / each))
    rows = max(1, min(shared_out, round(MOST_S / each), SHARD_ROWS))
    of_configuration = request.views_per_modification * request.passes
    return rows - rows % of_configuration if rows > of_configuration else rows  # others render its photons again


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
    other = scene_named(opened, halves_from) if halves_from else find_same_radiance(opened, named.spec)
    before = stored_spec(opened.storage, named.spec.scene_id)
    replaced = None
    if before is not None:
        then, now = (
            each.model_dump(mode="json", exclude={"scene", "stored_exponent"}) for each in (before, named.spec)
        )
        changes = differing(then, now).items()
        replaced = ", ".join(f"{key} ({was} before, {is_} now)" for key, (was, is_) in changes) or None
    with announce_work(opened.storage, named.spec.scene_id, "submit", log.warning):
        planned = opened.plan(named.spec, request, shard_rows=shard_rows, usual_rows=usual, halves_from=other)
    new_scene = planned.scene_id if planned.plan == 0 else False  # its jobs may have failed before it was forgotten
    queued = _queue(opened, redis_url, retry=retry or new_scene)
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
    queued = None if dry_run else _queue(opened, redis_url, retry=retry)
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


def _queue(store: Store, redis_url: str | None, *, retry: bool | str) -> int | None:
    """The number of jobs that are queued now; None without Redis. Workers that have none learn it from the store."""
    if retry is True:
        with store_errors("note a retry", store.storage.where):
            keep_retry(store)
    return None if redis_url is None else queue_missing(store, redis_url, retry=retry)


def queue_missing(store: Store, redis_url: str, *, retry: bool | str = False) -> int:
    """Queue every missing job of a store; returns how many.

    With `retry` also jobs that were set aside. Raises QueueError, which says that the plan is stored nevertheless.
    """
    try:
        connection = connect(redis_url)
        return reconcile(store, connection, retry=retry)
    except OtherStoreError as error:
        raise QueueError(f"{error}. The plan is stored in {store.storage.where}") from error
    except QueueError as error:
        how = "The plan is stored, and idle workers will find it; --no-queue submits without Redis"
        raise QueueError(f"{str(error).rstrip('.')}. {how}") from error
