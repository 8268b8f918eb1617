"""A scene's guides, which the renderer computes of each view, in a folder of their own below the scene's.

SCENE/guides/settings.json                  the settings they are rendered with; its presence gives the scene guides
SCENE/guides/plans/000000/                  a Zarr group with the guides' arrays, beside the plan of that number
SCENE/guides/committed/000000000000.json    a marker for each job whose new views have their guides

Rows, jobs, shards and markers are those of the scene's plans, so that guides can be added to a scene at any time: the
jobs that lack them are missing until workers have rendered them, and no radiance is rendered again.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from photonfarm.shared.core.errors import CorruptError, SpecError, store_errors
from photonfarm.shared.core.models import sentences
from photonfarm.shared.core.records import F32, Guides, arrays_of
from photonfarm.shared.scene.spec import GuideSpec, SceneSpec
from photonfarm.shared.store.format import declarations, markers, schema
from photonfarm.shared.store.io.storage import Storage, put_json
from photonfarm.shared.store.write import plans
from photonfarm.shared.store.write.commit import RowWriter
from photonfarm.shared.store.write.plans import JobRows, StoredPlan

GUIDES = "guides"
"""The folder of a scene's guides, below the scene's."""

SETTINGS = "settings.json"

NOISY = ("direct", "gloss", "point_light")
"""The guides that are sampled, with seeds of their own; they are rounded."""

RESTORE = "`photonfarm store check --repair` sets it aside, and `photonfarm store upgrade` writes it anew"
"""The remedy for damaged settings."""


class GuideStore:
    """The guides of one scene, which may have none."""

    def __init__(self, storage: Storage, scene: str, spec: SceneSpec) -> None:
        """Take the scene's folder; nothing is read yet."""
        self.storage = storage
        self.spec = spec
        self.scene_id = spec.scene_id
        self.name = f"{scene}/{GUIDES}"
        self._settings: GuideSpec | None = None

    def settings(self) -> GuideSpec | None:
        """The settings that they are rendered with; None if the scene has no guides. Raises CorruptError."""
        if self._settings is None:
            self._settings = _read_settings(self.storage, self.name)
        return self._settings

    def want(self, wanted: GuideSpec) -> bool:
        """Request guides for all views of present and future plans; False if that was done before.

        Raises SpecError if the scene has guides with other settings.
        """
        new = self.ask(wanted)
        self.check(wanted)
        return new

    def check(self, wanted: GuideSpec) -> None:
        """Raise SpecError if the scene has guides with other settings."""
        found = self.settings()
        if found is not None and found != wanted:
            raise SpecError(
                f"guides: {wanted.model_dump()} is asked for, and scene {self.scene_id} has guides with "
                f"{found.model_dump()}, fixed when they were first asked for; ask for these"
            )

    def ask(self, wanted: GuideSpec) -> bool:
        """Request guides for all views as `want` does; False if that was done before, with whatever settings."""
        with store_errors("ask for guides", self.storage.where):
            return put_json(self.storage, wanted.model_dump(mode="json"), f"{self.name}/{SETTINGS}")

    def committed_jobs(self) -> set[int]:
        """The jobs whose guides are there, by their markers."""
        return markers.jobs(self.storage, self.name)

    def is_committed(self, job: int) -> bool:
        """Whether a job's guides are there."""
        return self.storage.exists(markers.name_of(self.name, job))

    def marker(self, job: int) -> dict[str, Any]:
        """The marker of a job whose guides are there; raises as `SceneStore.marker` does."""
        return markers.read(self.storage, self.name, job)

    def lacks(
        self, found: Sequence[StoredPlan], among: Sequence[int], look: Callable[[], Set[int]] | None = None
    ) -> list[int]:
        """Which of some jobs, in order, have new views that still lack guides; none if the scene has no guides.

        `look` gives the jobs whose guides are there, where that costs less than to list all markers.
        """
        if self.settings() is None:
            return []
        done = (look or self.committed_jobs)()
        return jobs_with_views(found, [job for job in among if job not in done])

    def without(self, found: Sequence[StoredPlan]) -> list[int]:
        """The jobs of these plans with new views without guides, in order, even if the scene has no guides."""
        done = self.committed_jobs()
        return [job for job in jobs_with_views(found) if job not in done]

    def lacks_job(self, rows: JobRows) -> bool:
        """Whether a job has new views without guides, in a scene that has guides."""
        return bool(rows.new_views) and self.settings() is not None and not self.is_committed(rows.job)

    def writer(self, rows: JobRows, plan: StoredPlan) -> GuideWriter:
        """A writer that takes the guides of a job's new views and commits them; it declares their arrays first."""
        own = beside(plan, self.name)
        self._declare(own)
        return GuideWriter(self, rows, own)

    def _declare(self, plan: StoredPlan) -> None:
        """Declare the arrays of a plan's guides, unless they are declared."""
        if self.storage.exists(f"{plan.folder}/zarr.json"):
            return
        with store_errors("declare the guides of a plan", self.storage.where):
            part = self.storage.part()
            try:
                build(part, self.spec, plan)
                self.storage.adopt_folder(part, plan.folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)


def build(part: Path, spec: SceneSpec, plan: StoredPlan) -> None:
    """Declare the arrays of the guides of a plan at full size, in a new folder."""
    import zarr

    from photonfarm.shared.store.write.staging import group_in

    attributes: Any = {**declarations.stamp(), "scene": spec.scene_id, "first_job": plan.first_job}
    with group_in(part) as store:
        group = zarr.open_group(store, mode="w-", zarr_format=3, attributes=attributes)
        arrays = schema.guide_arrays(spec).values()
        schema.create_outputs(group, arrays, plan.jobs * plan.shard_rows, plan.shard_rows)


def beside(plan: StoredPlan, guides: str) -> StoredPlan:
    """The plan with the folder of its guides' arrays; `guides` is the folder of the scene's guides."""
    return replace(plan, folder=plans.folder(guides, plan.number))


def jobs_with_views(found: Sequence[StoredPlan], among: Sequence[int] | None = None) -> list[int]:
    """Which jobs of plans, or which of some of them, have new views, in order."""
    having: list[int] = []
    for plan in found:
        has_views = ~np.isnan(plan.rows.view[:, 0]).reshape(-1, plan.shard_rows).all(axis=1)
        having += (plan.first_job + np.flatnonzero(has_views)).tolist()
    return having if among is None else sorted(set(having) & set(among))


def has_guides(found: Sequence[StoredPlan], done: Set[int]) -> NDArray[np.bool_]:
    """Whether the view in each row of the scene has guides, (rows of all plans,), given the jobs that have them."""
    if not found:
        return np.zeros(0, np.bool_)
    jobs = np.zeros(found[-1].end_job, np.bool_)
    jobs[[job for job in done if job < len(jobs)]] = True
    return np.repeat(jobs, found[0].shard_rows)


def used_views(found: Sequence[StoredPlan]) -> NDArray[np.bool_]:
    """Whether each row of the scene has a view, (rows of all plans,)."""
    return np.concatenate([np.zeros(0, np.bool_), *(~np.isnan(plan.rows.view[:, 0]) for plan in found)])


def _read_settings(storage: Storage, guides: str) -> GuideSpec | None:
    name = f"{guides}/{SETTINGS}"
    where = f"{storage.where}/{name}"
    with store_errors("read the settings of the guides", storage.where):
        if not storage.exists(name):
            return None
        content = storage.read(name)
    try:
        return GuideSpec.model_validate(json.loads(content), extra="ignore")  # a later program may add keys
    except ValidationError as error:
        raise CorruptError(f"{where}: {'; '.join(sentences(error))}; {RESTORE}") from error
    except (ValueError, RecursionError) as error:
        raise CorruptError(f"{where}: is not JSON: {error}; {RESTORE}") from error


class GuideWriter(RowWriter):
    """Takes the guides of a job's new views."""

    def __init__(self, guides: GuideStore, rows: JobRows, plan: StoredPlan) -> None:
        """Begin; `GuideStore.writer` calls this."""
        super().__init__(guides, rows, plan, schema.guide_arrays(guides.spec))

    def guides(self, row: int, guides: Guides) -> None:
        """Add the guides of a new view row."""
        self._claim("view", row, "guides", self._rows.new_views)
        for name, values in arrays_of(guides).items():
            self._put(row, name, rounded(values) if name in NOISY else values)

    def _expected(self) -> dict[schema.RowKind, tuple[str, Set[int]]]:
        return {"view": ("guides", self._rows.new_views)}

    def _check_readable(self) -> None:
        for name in self._arrays:
            self._check_rows(name, self._rows.new_views)


def rounded(values: NDArray[Any]) -> F32:
    """Numbers rounded to 8 significant bits, to nearest with ties to even; noisy values need no more.

    The two lower bytes are then 0 and take no room once compressed. Finite values must not be within 0.4 % of the
    largest float32.
    """
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    to_even = (bits >> np.uint32(16)) & np.uint32(1)
    kept: F32 = ((bits + np.uint32(0x7FFF) + to_even) & np.uint32(0xFFFF0000)).view(np.float32)
    return kept
