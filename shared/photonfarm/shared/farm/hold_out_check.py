"""Whether a request leaves something to train on and something to validate on, checked before anything is rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.plan.hold_out import are_held_out, units_of
from photonfarm.shared.plan.request import SHARD_ROWS, PlannedContent, Request, expand
from photonfarm.shared.plan.top_up import PlannedViews
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import is_vacant
from photonfarm.shared.store.write.plans import content


def check_hold_out(spec: SceneSpec, store: str | Path, share: float, request: Request) -> None:
    """Raise SpecError if nothing or everything of what is planned and requested would be held out.

    Nothing is written. The trainer checks the same, but only after everything is rendered.
    """
    wanted = request.model_copy(update={"passes": 1})
    if spec.groups:
        wanted = wanted.model_copy(update={"views_per_modification": 1})  # the configuration alone decides
    planned = _planned(spec, store, wanted)
    keys = set(units_of(planned, np.arange(len(planned.view_row))))
    held_out = sum(are_held_out(keys, share))
    found = f"hold_out = {share:g}: of the {len(keys)} {'configurations' if spec.groups else 'views'} planned"
    if not held_out:
        raise SpecError(f"{found} none is held out, and one is needed to validate on; raise it, or plan more")
    if held_out == len(keys):
        raise SpecError(f"{found} all are held out, and none is left to train on; lower it, or plan more")


def _planned(spec: SceneSpec, store: str | Path, wanted: Request) -> PlannedViews:
    """The views of a scene's plans and of a request."""
    plans = []
    if not is_vacant(store) and spec.scene_id in (opened := Store(store)).scene_ids():
        plans = opened.scene(spec.scene_id).plans()
    known = content(plans)
    first_job, shard_rows = (plans[-1].end_job, plans[0].shard_rows) if plans else (0, SHARD_ROWS)
    new = expand(spec, wanted, known, first_job=first_job, shard_rows=shard_rows).rows
    more = [] if new is None else [(first_job * shard_rows, new)]
    return PlannedViews.of(spec, PlannedContent([*known.plans, *more]))
