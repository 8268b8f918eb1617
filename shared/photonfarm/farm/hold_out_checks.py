"""Checks, before anything is rendered, that a request leaves configurations to train on and to validate on."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.formatting import format_count
from photonfarm.core.keys import Key
from photonfarm.plan.hold_out import HOLD_OUT, are_held_out, enough, sides_of, units_of
from photonfarm.plan.request import SHARD_ROWS, PlannedContent, Request, expand
from photonfarm.plan.top_up import PlannedViews
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.model.plans import StoredPlan, content, load_all
from photonfarm.store.model.scene_store import SCENES

MOST_NAMED = 4096
"""The largest number of configurations that a message proposes."""

MOST_TRIED = 256
"""The requested configurations that a warning looks at: of so many, all are on one side once in 10^14 cases."""


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
        more = _find_least(request, lambda wanted: enough(_list_units(spec, plans, wanted)) is not None)
        remedy = f"--modifications {more} plans enough" if more else "the spec has no other, as nothing in it varies"
        kind = "configuration" if spec.groups else "view"
        raise SpecError(f"{len(keys)} {kind} is planned: one to train on and one to validate on are needed; {remedy}")
    return share


def find_hold_out_warning(spec: SceneSpec, store: str | Path, request: Request) -> str | None:
    """Why `train` with the default share would refuse what is planned and requested; None if it would not.

    A store that cannot be read is left to those who write into it.
    """
    few = request.model_copy(update={"modifications": min(request.modifications, MOST_TRIED)})
    if _find_fault(spec, [], HOLD_OUT, few) is None:
        return None  # and so with what else is planned, which may be much to read
    with suppress(StoreError):
        if fault := _find_fault(spec, _read_plans(spec, store), HOLD_OUT, few):
            return f"`photonfarm train` will refuse this: {fault}"
    return None


def _find_fault(spec: SceneSpec, plans: list[StoredPlan], share: float, request: Request) -> str | None:
    """What is wrong with a share for what is planned and requested, and the numbers that would do, in words."""

    def is_split(wanted: Request) -> bool:
        views = _list_views(spec, plans, wanted)
        return {*sides_of(views, np.arange(len(views.view_row)), share)} >= {"train", "held-out"}

    if is_split(request):
        return None
    keys, remedies = _list_units(spec, plans, request), []
    if (other := enough(keys, least=0.0)) is not None:
        remedies.append(f"--hold-out {other:g} holds out one of these")
    if more := _find_least(request, is_split):
        remedies.append(f"--modifications {more} plans enough")
    all_are = any(are_held_out(keys, share))
    which = "all are held out, and none is left to train on" if all_are else "none is held out, and one is needed"
    planned = format_count(len(keys), "configuration" if spec.groups else "view")
    remedy = ", and ".join(remedies) or "plan more, or use another --hold-out"
    return f"hold_out = {share:g}: of the {planned} planned {which}; {remedy}"


def _find_least(request: Request, suffices: Callable[[Request], bool]) -> int | None:
    """The least number of configurations, from the request's upwards, that suffices, as more then do; None: no such."""

    def do_suffice(modifications: int) -> bool:
        return suffices(request.model_copy(update={"modifications": modifications}))

    first = min(request.modifications, MOST_NAMED)
    least = bisect_left(range(MOST_NAMED), True, lo=first, key=do_suffice)
    return least if least < MOST_NAMED else None


def _list_units(spec: SceneSpec, plans: list[StoredPlan], request: Request) -> set[Key]:
    """The keys by which what is planned and requested is held out: of configurations, or of a static scene's views.

    What a person chose has none, as it is never held out.
    """
    views = _list_views(spec, plans, request)
    every = np.arange(len(views.view_row))
    return set(units_of(views, every[views.are_uniform(every)]))


def _list_views(spec: SceneSpec, plans: list[StoredPlan], request: Request) -> PlannedViews:
    """What is planned and requested, as far as it decides what is held out."""
    wanted = request.model_copy(update={"passes": 1})
    if spec.groups:
        wanted = wanted.model_copy(update={"views_per_modification": 1})  # the configuration alone decides
    known = content(plans)
    first_job, shard_rows = (plans[-1].end_job, plans[0].shard_rows) if plans else (0, SHARD_ROWS)
    new_rows = expand(spec, wanted, known, first_job=first_job, shard_rows=shard_rows).rows
    new_plans = [] if new_rows is None else [(first_job * shard_rows, new_rows)]
    return PlannedViews.of(spec, PlannedContent([*known.plans, *new_plans]))


def _read_plans(spec: SceneSpec, store: str | Path) -> list[StoredPlan]:
    """The plans of a scene; none if the store does not have it."""
    return [] if is_vacant(store) else load_all(Store(store).storage, f"{SCENES}/{spec.scene_id}", [])
