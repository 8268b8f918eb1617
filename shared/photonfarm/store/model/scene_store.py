"""One scene of a store, for planning and rendering: its spec, plans, jobs, base and markers.

Plans and markers are the truth. Nothing here needs a lock: a name appears once, and the first one stays.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from photonfarm.core.errors import CorruptError, SpecError, StoreError, store_errors
from photonfarm.core.models import sentences
from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.plan.request import (
    MAX_SHARD_ROWS,
    SHARD_ROWS,
    Extent,
    PlannedContent,
    SamplesToPlan,
    expand_samples,
)
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format import declarations, markers, schema
from photonfarm.store.format.markers import FollowedMarkers
from photonfarm.store.io.storage import Storage, put_json
from photonfarm.store.model import findings, plans
from photonfarm.store.model.plans import AnyRequest, JobRows, StoredPlan

SCENES = "scenes"

_SCENE_ID = re.compile("[0-9a-f]{32}")


@dataclass(frozen=True, slots=True)
class PlanResult:
    """The outcome of a request."""

    scene_id: str
    plan: int | None  # number of the new plan; None if nothing was new, or nothing was written
    new: int  # samples planned now
    known: int  # samples of the request that older plans hold
    jobs: int  # jobs of the new plan
    extent: Extent  # as in `Expansion`


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a scene, in samples."""

    planned_samples: int
    committed_samples: int  # complete ones
    planned_passes: int  # of the planned samples, further passes: those that top-ups planned
    committed_passes: int  # of these, the complete ones


class SceneStore:
    """One scene of a store."""

    def __init__(self, storage: Storage, scene_id: str, spec: SceneSpec | None = None) -> None:
        """Open; raises StoreError if there is no such scene. A `spec` stands for the stored one, if that is lost."""
        self.storage = storage
        self.scene_id = scene_id
        self.name = f"{SCENES}/{scene_id}"  # of its folder
        self.spec = read_spec(storage, scene_id) if spec is None else stored_spec(storage, scene_id) or spec
        self._plans: list[StoredPlan] = []
        self._followed = FollowedMarkers(storage, self.name)

    def reread(self) -> None:
        """Take up what a later submission has changed of the spec: name, credits, exposure or strategy."""
        self.spec = read_spec(self.storage, self.scene_id)

    @property
    def folder(self) -> Path:
        """The scene's folder, of a store on this machine's file system."""
        return self.storage.local(self.name)

    # ------------------------------------------------------------------------------------------------------------ plans

    def plans(self) -> list[StoredPlan]:
        """The plans that are there by now, in order."""
        known, self._plans = self._plans, plans.load_all(self.storage, self.name, self._plans)
        if known[:1] != self._plans[:1]:
            self._followed.doubt()  # the scene was forgotten since
        return self._plans

    def plan(
        self,
        request: AnyRequest,
        *,
        shard_rows: int | None = None,
        usual_rows: int = SHARD_ROWS,
        halves_from: str | None = None,
        samples: Callable[[PlannedContent], SamplesToPlan] | None = None,
        dry_run: bool = False,
    ) -> PlanResult:
        """Plan the new samples of a request; concurrent submitters try again, each after the other's plan.

        `halves_from` is the id of a scene with the same radiance id, whose halves the jobs take over. `samples`
        gives what is to be planned, instead of the request, from what is planned already. Callers are at work in the
        scene, or have its lease. Raises SpecError for an invalid request or number of rows, and CorruptError if a plan
        is missing.
        """
        while True:
            last = max(markers.list_jobs(self.storage, self.name), default=-1)
            stored_plans = self.plans()  # after the markers: each one's plan is there by now
            rows_per_job = self._shard_rows(stored_plans, shard_rows, usual_rows)
            first_job = stored_plans[-1].end_job if stored_plans else 0
            if last >= first_job:
                raise CorruptError(
                    f"{self.storage.where}/{markers.marker_name(self.name, last)}: no plan has this job, and a new "
                    "plan would take its number; `photonfarm store check` reports whether the last plan is missing"
                )
            numbers = {"first_job": first_job, "shard_rows": rows_per_job}
            if samples is None:
                expansion = plans.expand_request(self.spec, request, stored_plans, **numbers)
            else:
                expansion = expand_samples(samples(plans.content(stored_plans)), **numbers)
            result = PlanResult(self.scene_id, None, expansion.new, expansion.known, 0, expansion.extent)
            if expansion.rows is None or dry_run:
                return result
            with store_errors("write a plan", self.storage.where), self._building() as built:
                plans.build(built, self.spec, request, expansion.rows, **numbers, halves_from=halves_from)
                if self.storage.adopt_folder(built, plans.folder(self.name, len(stored_plans))):
                    jobs = len(expansion.rows.sample_pass) // rows_per_job
                    return replace(result, plan=len(stored_plans), jobs=jobs)

    @contextlib.contextmanager
    def _building(self) -> Iterator[Path]:
        """A folder to build that is removed again unless it is adopted."""
        built = self.storage.part()
        try:
            yield built
        finally:
            shutil.rmtree(built, ignore_errors=True)

    def _shard_rows(self, stored_plans: list[StoredPlan], wanted: int | None, usual: int) -> int:
        if wanted is not None and not 1 <= wanted <= MAX_SHARD_ROWS:
            raise SpecError(f"shard_rows = {wanted}: 1 to {MAX_SHARD_ROWS} samples per job are allowed")
        if not stored_plans:
            return wanted or usual
        if wanted not in (None, stored_plans[0].shard_rows):
            raise SpecError(
                f"shard_rows = {wanted}: scene {self.scene_id} has {stored_plans[0].shard_rows} samples per job, "
                "fixed by its first plan; leave the setting out"
            )
        return stored_plans[0].shard_rows

    # ------------------------------------------------------------------------------------------------------------- jobs

    def job_rows(self, job: int) -> JobRows:
        """The inputs and outputs of a job; raises IndexError for a job of no plan."""
        if not any(job in plan.own_jobs for plan in self._plans):
            self.plans()
        return plans.job_rows(self._plans, job)

    def jobs(self) -> int:
        """The number of planned jobs; they are numbered from 0."""
        stored_plans = self.plans()
        return stored_plans[-1].end_job if stored_plans else 0

    def committed_jobs(self) -> set[int]:
        """The jobs that have their marker."""
        return markers.list_jobs(self.storage, self.name)

    def missing_jobs(self, *, followed: bool = False) -> list[int]:
        """The jobs that are planned and not committed, in order.

        `followed` is for callers who ask often, as in `progress`: they may be told late of jobs that a repair has set
        aside, and should ask without it before they take nothing to be missing.
        """
        done = self._followed.look() if followed else self.committed_jobs()
        jobs = range(self.jobs())
        left_out = done | self.withdrawn_jobs()
        return [job for job in jobs if job not in left_out]

    def withdrawn_jobs(self) -> frozenset[int]:
        """The jobs of the plans as they were last read that are not to be rendered any more."""
        return frozenset().union(*(plan.withdrawn for plan in self._plans))

    def is_to_do(self, job: int) -> bool:
        """Whether a job is planned, and neither committed nor withdrawn."""
        return not self.is_committed(job) and job < self.jobs() and job not in self.withdrawn_jobs()

    def is_forgotten(self, rows: JobRows) -> bool:
        """Whether the scene was forgotten since a job was planned with these rows; it may be planned anew."""
        stored_plans = self.plans()
        return not stored_plans or stored_plans[0].forgotten != rows.plan.forgotten

    def is_still_to_do(self, rows: JobRows) -> bool:
        """Whether a job is to do, and planned with these rows still."""
        return self.is_to_do(rows.job) and not self.is_forgotten(rows)

    def is_committed(self, job: int) -> bool:
        """Whether a job has its marker."""
        return self.storage.exists(markers.marker_name(self.name, job))

    def marker(self, job: int) -> dict[str, Any]:
        """The marker of a committed job: its files and its figures."""
        return markers.read_marker(self.storage, self.name, job)

    def progress(self, *, followed: bool = False) -> Progress:
        """The scene's progress; costs one listing of the markers.

        It costs those who ask often less if it is `followed`: what a repair sets aside may then be seen late
        (`FollowedMarkers`).
        """
        return self.progress_of(self._followed.look() if followed else self.committed_jobs())

    def progress_of(self, committed: set[int]) -> Progress:
        """The scene's progress, given the jobs that have their marker."""
        stored_plans = self.plans()  # after the markers: each one's plan is there by now
        complete = plans.complete_rows(stored_plans, committed)
        further = [plan for plan in stored_plans if isinstance(plan.request, TopUp)]
        return Progress(
            planned_samples=sum(plan.samples for plan in stored_plans),
            committed_samples=int(np.count_nonzero(complete)),
            planned_passes=sum(plan.samples for plan in further),
            committed_passes=sum(int(np.count_nonzero(complete[p.first_row : p.end_row])) for p in further),
        )

    # ------------------------------------------------------------------------------------------------------------- base

    def has_base(self) -> bool:
        """Whether geometry and base cloud are complete."""
        return self.storage.exists(f"{self.name}/base/zarr.json")

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud; raises StoreError while they are not there."""
        geometry, cloud = read_base(self.storage, self.name)
        return geometry, replace(cloud, pivots=self.spec.pivots)

    def write_base(self, geometry: Geometry, cloud: BasePointCloud) -> None:
        """Store geometry and base point cloud; the first ones written stay."""
        from photonfarm.store.format.metadata import new_group

        if self.has_base():
            return
        with store_errors("write the base", self.storage.where), self._building() as built:
            with new_group(built, declarations.stamp()) as root:
                for name, record in (("geometry", geometry), ("cloud", cloud)):
                    group = root.create_group(name, attributes=declarations.stamp())
                    for declared in declarations.BASE[name]:
                        schema.create_input(group, declared, getattr(record, declared.name))
            self.storage.adopt_folder(built, f"{self.name}/base")


def scene_ids(storage: Storage) -> list[str]:
    """The scenes that are there, in order of their ids; foreign folders among them are ignored."""
    return sorted(name for name in storage.names(SCENES) if is_there(storage, name))


def is_there(storage: Storage, scene_id: str) -> bool:
    """Whether a scene is there: its spec, which is written first, or plans or markers whose spec is lost."""
    if not _SCENE_ID.fullmatch(scene_id):
        return False
    name = f"{SCENES}/{scene_id}"
    with store_errors("look for a scene", storage.where), contextlib.suppress(NotADirectoryError):  # somebody's file
        kept = (plans.PLANS, markers.COMMITTED)
        return storage.exists(f"{name}/spec.json") or any(
            not each.startswith(plans.FORGOTTEN) for part in kept for each in storage.names(f"{name}/{part}")
        )
    return False


def list_scenes(storage: Storage) -> str:
    """The scenes that are there, by name and id, in words."""
    named = []
    for scene_id in scene_ids(storage):
        try:
            named.append(f"{read_spec(storage, scene_id).name} ({scene_id})")
        except StoreError:
            named.append(f"{scene_id} (unreadable)")
    return f"it holds {', '.join(named) or 'none yet'}"


def are_there(storage: Storage) -> bool:
    """Whether a place that may not be a store has folders of scenes; raises StoreError if it cannot be read."""
    with store_errors("look for scenes", storage.where):
        return SCENES in storage.names("") and any(map(_SCENE_ID.fullmatch, storage.names(SCENES)))


def read_spec(storage: Storage, scene_id: str) -> SceneSpec:
    """The spec of a scene; raises StoreError if there is no such scene, CorruptError if its spec is lost or damaged."""
    name = f"{SCENES}/{scene_id}/spec.json"
    try:
        spec = SceneSpec.model_validate_json(storage.read(name))
    except FileNotFoundError as error:
        if not is_there(storage, scene_id):
            raise StoreError(f"{storage.where}: holds no scene {scene_id}; {list_scenes(storage)}") from error
        if storage.exists(name):  # a submission has begun the scene in the meantime
            return read_spec(storage, scene_id)
        raise CorruptError(
            f"{storage.where}/{name}: is missing, and plans or markers of the scene are there; `photonfarm submit` of "
            "the same spec writes it again"
        ) from error
    except OSError as error:
        raise StoreError(f"{storage.where}/{name}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        why = "; ".join(sentences(error))
        raise CorruptError(f"{storage.where}/{name}: is not a scene spec: {why}; {findings.SET_ASIDE}") from error
    if spec.scene_id != scene_id:
        why = f"has scene id {spec.scene_id}, not that of its folder"
        raise CorruptError(f"{storage.where}/{name}: {why}; {findings.SET_ASIDE}")
    return spec


def stored_spec(storage: Storage, scene_id: str) -> SceneSpec | None:
    """The stored spec of a scene; None if it is lost, or nothing of the scene is there. Raises as `read_spec`."""
    with store_errors("look for a spec", storage.where):
        is_stored = storage.exists(f"{SCENES}/{scene_id}/spec.json")
    return read_spec(storage, scene_id) if is_stored else None


def write_spec(storage: Storage, spec: SceneSpec) -> None:
    """Store the spec of a scene; one that is there is replaced if it differs in what no id covers.

    The power of two by which radiance is stored stays what it was at first. Raises CorruptError for a damaged spec.
    """
    folder = f"{SCENES}/{spec.scene_id}"
    name = f"{folder}/spec.json"
    there = stored_spec(storage, spec.scene_id)
    exponent = _exponent_of_plans(storage, folder) if there is None else there.radiance_exponent
    stored = spec.model_copy(update={"stored_exponent": spec.radiance_exponent if exponent is None else exponent})
    if stored != there:
        put_json(storage, stored.model_dump(mode="json"), name, replace=there is not None)


def _exponent_of_plans(storage: Storage, scene: str) -> int | None:
    """The power of two by which plans whose spec is lost store radiance; None without plans.

    Raises CorruptError if there are plans and none can be read.
    """
    numbers = range(plans.count(storage, scene))
    for number in numbers:
        with contextlib.suppress(CorruptError):
            return plans.open_plan(storage, plans.folder(scene, number))[1].radiance_exponent
    if numbers:
        raise CorruptError(f"{storage.where}/{scene}: the spec is lost, and no plan can be read; {findings.RESTORE}")
    return None


def read_base(storage: Storage, scene: str) -> tuple[Geometry, BasePointCloud]:
    """Geometry and base point cloud in a scene's folder; raises StoreError while they are not there."""
    from photonfarm.store.format.metadata import open_group

    folder = f"{scene}/base"
    if not storage.exists(f"{folder}/zarr.json"):
        raise StoreError(f"{storage.where}/{scene}: its base is not there yet; the first job of the scene writes it")
    try:
        root, _ = open_group(storage, folder)

        def read_arrays(part: str) -> dict[str, Any]:
            names = [declared.name for declared in declarations.BASE[part]]
            return {name: schema.read_input(storage, f"{folder}/{part}/{name}", root[part][name]) for name in names}

        return Geometry(**read_arrays("geometry")), BasePointCloud(**read_arrays("cloud"))
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, FileNotFoundError) as error:
        why = f"{error}; {findings.BASE_ASIDE}"
        raise CorruptError(f"{storage.where}/{folder}: is not what was committed: {why}") from error
