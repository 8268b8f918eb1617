"""Whether a request leaves something to train on and something to validate on, checked before anything is rendered."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.keys import Key
from photonfarm.shared.plan.hold_out import are_held_out
from photonfarm.shared.plan.request import SHARD_ROWS, PlannedContent, PlannedRows, Request, expand
from photonfarm.shared.plan.sampling import modification_keys, view_keys
from photonfarm.shared.scene.modification import rest
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.shared.store.io.storage import is_vacant


def check_hold_out(spec: SceneSpec, store: str | Path, share: float, request: Request) -> None:
    """Raise SpecError if nothing or everything of what is planned and requested would be held out.

    Nothing is written. The trainer checks the same, but only after everything is rendered.
    """
    wanted = request.model_copy(update={"passes": 1})
    if spec.groups:
        wanted = wanted.model_copy(update={"views_per_modification": 1})  # the configuration alone decides
    keys = {key for rows in _planned(spec, store, wanted) for key in _units(spec, rows)}
    held_out = sum(are_held_out(keys, share))
    found = f"hold_out = {share:g}: of the {len(keys)} {'configurations' if spec.groups else 'views'} planned"
    if not held_out:
        raise SpecError(f"{found} none is held out, and one is needed to validate on; raise it, or plan more")
    if held_out == len(keys):
        raise SpecError(f"{found} all are held out, and none is left to train on; lower it, or plan more")


def _planned(spec: SceneSpec, store: str | Path, wanted: Request) -> Iterator[PlannedRows]:
    """The rows of a scene's plans, and those of a request."""
    if not is_vacant(store) and spec.scene_id in (opened := Store(store)).scene_ids():
        yield from (plan.rows for plan in opened.scene(spec.scene_id).plans())
    new = expand(spec, wanted, PlannedContent(), first_job=0, shard_rows=SHARD_ROWS).rows
    if new is not None:
        yield new


def _units(spec: SceneSpec, rows: PlannedRows) -> list[Key]:
    """The keys of the configurations in these rows; of a static scene, those of its views."""
    if spec.groups:
        vectors = rows.modification[~np.isnan(rows.modification).any(axis=(1, 2))]
        return modification_keys(spec, vectors)
    views = rows.view[~np.isnan(rows.view).any(axis=1)]
    return view_keys([rest(spec).key(spec.scene_id)] * len(views), views)
