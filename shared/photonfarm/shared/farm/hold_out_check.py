"""Whether a request leaves something to train on and something to validate on, checked before anything is rendered."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from photonfarm.shared.core.errors import SpecError, StoreError
from photonfarm.shared.core.keys import Key
from photonfarm.shared.plan.hold_out import HOLD_OUT, are_held_out, enough, units_of
from photonfarm.shared.plan.request import SHARD_ROWS, PlannedContent, Request, expand
from photonfarm.shared.plan.top_up import PlannedViews
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import is_vacant
from photonfarm.shared.store.write.plans import StoredPlan, content

MOST_NAMED = 4096
"""The largest number of configurations that a message proposes."""

PLENTY = 256
"""So many configurations are split by the default share, but for one case in 10^14; more are not looked at."""


def check_hold_out(spec: SceneSpec, store: str | Path, share: float, request: Request) -> None:
    """Raise SpecError if nothing or everything of what is planned and requested would be held out.

    Nothing is written. The message names numbers that would do. The trainer checks the same, but only after everything
    is rendered.
    """
    if (fault := _fault(spec, _plans(spec, store), share, request)) is not None:
        raise SpecError(fault)


def chosen_hold_out(spec: SceneSpec, store: str | Path, request: Request) -> float:
    """The share to hold out where a user names none: the default, or just enough for one of what a small plan has.

    Raises SpecError if there is only one configuration (in a static scene, view).
    """
    plans = _plans(spec, store)
    keys = _units(spec, plans, request)
    share = enough(keys) or enough(keys, least=0.0)
    if share is None:
        more = _least(request, lambda wanted: enough(_units(spec, plans, wanted)) is not None)
        remedy = f"--modifications {more} plans enough" if more else "the spec has no other, as nothing in it varies"
        kind = "configuration" if spec.groups else "view"
        raise SpecError(f"{len(keys)} {kind} is planned: one to train on and one to validate on are needed; {remedy}")
    return share


def hold_out_warning(spec: SceneSpec, store: str | Path, request: Request) -> str | None:
    """Why `train` with the default share would refuse what is planned and requested; None if it would not.

    A store that cannot be read is left to those who write into it.
    """
    few = request.model_copy(update={"modifications": min(request.modifications, PLENTY)})
    if _splits(are_held_out(_units(spec, [], few), HOLD_OUT)):
        return None  # whatever else is planned, which may be much
    with suppress(StoreError):
        if (fault := _fault(spec, _plans(spec, store), HOLD_OUT, few)) is not None:
            return f"`photonfarm train` will refuse this: {fault}"
    return None


def _fault(spec: SceneSpec, plans: list[StoredPlan], share: float, request: Request) -> str | None:
    """What is wrong with a share for what is planned and requested, and the numbers that would do, in words."""
    keys = _units(spec, plans, request)
    held_out = are_held_out(keys, share)
    if _splits(held_out):
        return None
    found = []
    if (other := enough(keys, least=0.0)) is not None:
        found.append(f"--hold-out {other:g} holds out one of these")
    if more := _least(request, lambda wanted: _splits(are_held_out(_units(spec, plans, wanted), share))):
        found.append(f"--modifications {more} plans enough")
    which = "all are held out, and none is left to train on" if any(held_out) else "none is held out, and one is needed"
    of = f"of the {len(keys)} {'configuration' if spec.groups else 'view'}{'s' * (len(keys) != 1)} planned"
    return f"hold_out = {share:g}: {of} {which}; {', and '.join(found) or 'plan more, or use another --hold-out'}"


def _splits(held_out: list[bool]) -> bool:
    """Whether some are held out, and some are not."""
    return 0 < sum(held_out) < len(held_out)


def _least(request: Request, works: Callable[[Request], bool]) -> int | None:
    """The least number of configurations from the request's on that works, as more of them then do; None: not found."""
    among = range(MOST_NAMED)

    def of(modifications: int) -> bool:
        return works(request.model_copy(update={"modifications": modifications}))

    found = bisect_left(among, True, lo=min(request.modifications, MOST_NAMED), key=of)
    return found if found < MOST_NAMED else None


def _units(spec: SceneSpec, plans: list[StoredPlan], request: Request) -> set[Key]:
    """What is held out as one, of all that is planned and requested: configurations, or a static scene's views."""
    wanted = request.model_copy(update={"passes": 1})
    if spec.groups:
        wanted = wanted.model_copy(update={"views_per_modification": 1})  # the configuration alone decides
    planned = _planned(spec, plans, wanted)
    return set(units_of(planned, np.arange(len(planned.view_row))))


def _plans(spec: SceneSpec, store: str | Path) -> list[StoredPlan]:
    """The plans of a scene; none if the store does not have it."""
    if not is_vacant(store) and spec.scene_id in (opened := Store(store)).scene_ids():
        return opened.scene(spec.scene_id).plans()
    return []


def _planned(spec: SceneSpec, plans: list[StoredPlan], wanted: Request) -> PlannedViews:
    """The views of a scene's plans and of a request."""
    known = content(plans)
    first_job, shard_rows = (plans[-1].end_job, plans[0].shard_rows) if plans else (0, SHARD_ROWS)
    new = expand(spec, wanted, known, first_job=first_job, shard_rows=shard_rows).rows
    more = [] if new is None else [(first_job * shard_rows, new)]
    return PlannedViews.of(spec, PlannedContent([*known.plans, *more]))
