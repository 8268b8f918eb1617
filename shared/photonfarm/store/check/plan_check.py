"""Reads what a scene's jobs are made from and refer to: its plans and its base.

Zarr reads a missing chunk as fill values, in silence; so the chunks are counted first.

Files that belong to no committed job are found here too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.plan.request import UNUSED, PlannedContent, sample_keys
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format import declarations, markers, schema
from photonfarm.store.io.storage import Storage
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Cause, Finding
from photonfarm.store.model.plans import StoredPlan
from photonfarm.store.model.scene_store import SCENES, read_base

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, RuntimeError, FileNotFoundError)
"""What zarr-python raises for damaged metadata and chunks; a group in place of an array lacks its attributes."""


@dataclass(eq=False)
class CheckedScene:
    """A scene that is being checked, and what `check_plans` has learned of its plans."""

    storage: Storage
    spec: SceneSpec
    plans: list[StoredPlan] | None = None  # None if one is damaged: then only what markers state can be checked
    shard_rows: int | None = None  # as the first readable plan states
    lost: set[str] = field(default_factory=set)  # folders of plans that are missing

    @property
    def scene_id(self) -> str:
        """The scene's id."""
        return self.spec.scene_id

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{SCENES}/{self.scene_id}"

    @cached_property
    def arrays(self) -> dict[str, schema.ArraySchema]:
        """The arrays that jobs store there, by name."""
        return schema.output_arrays(self.spec)

    def finding(
        self, cause: Cause, detail: str, file: str | None = None, *, job: int | None = None, row: int | None = None
    ) -> Finding:
        """A finding about the scene, or about a job of it."""
        return Finding(cause, detail, self.scene_id, job, row, file)

    def unreadable(self, file: str, error: OSError, job: int | None = None) -> Finding:
        """The finding for a file that cannot be read; raises OSError if the whole store cannot be read."""
        self.storage.names(self.name)
        return self.finding(Cause.UNREADABLE, error.strerror or str(error), file, job=job)

    def files_of(self, job: int) -> dict[str, str]:
        """The names that a job's files may have, by array; empty for a job of no known plan."""
        for plan in self.plans or []:
            if job in plan.own_jobs:
                return {name: plan.shard(name, array, job) for name, array in self.arrays.items()}
        return {}


# ---------------------------------------------------------------------------------------------------------------- plans


def check_plans(scene: CheckedScene) -> list[Finding]:
    """What is wrong with the plans; the scene then has them, unless one is damaged."""
    scene.plans, scene.lost = None, set()
    findings: list[Finding] = []
    for number in range(plans.count(scene.storage, scene.name)):
        folder = plans.folder(scene.name, number)
        try:
            findings += _check_plan(scene, folder)
        except OSError as error:
            findings.append(scene.unreadable(folder, error))
    if findings:
        return findings
    try:
        there = plans.load_all(scene.storage, scene.name, [])
    except StoreError as error:
        return [scene.finding(Cause.PLAN, str(error))]
    inputs = plans.content(there)
    findings = list(_check_references(scene, there, inputs)) if there else []
    if not findings:
        scene.plans = there
    return findings or (list(_check_keys(scene, there, inputs)) if there else [])


def _check_plan(scene: CheckedScene, folder: str) -> Iterator[Finding]:
    """Yield what is wrong with the files of a plan."""
    document = f"{folder}/zarr.json"
    if not scene.storage.exists(document):
        scene.lost.add(folder)
        yield scene.finding(Cause.PLAN, findings.MISSING, document)
        return
    try:
        group, about = plans.open_plan(scene.storage, folder)
    except StoreError as error:
        yield scene.finding(Cause.PLAN, str(error).partition(": ")[2], document)
        return
    scene.shard_rows = scene.shard_rows or about.shard_rows
    remedy = plans.remedy_for(about.request)
    for name in plans.INPUTS:
        if detail := _describe_damage(scene.storage, f"{folder}/{name}", group, name):
            yield scene.finding(Cause.PLAN_INPUTS, f"{detail}; {remedy}", f"{folder}/{name}")
    for file in about.checksums:
        name = file.partition("/")[0]
        if name in (file, *plans.INPUTS):
            continue
        try:  # the declaration of an output, by which other programs read it
            _ = group[name]
        except UNREADABLE as error:
            detail = f"cannot be read: {plans.reason(error)}; {remedy}"
            yield scene.finding(Cause.PLAN_INPUTS, detail, f"{folder}/{file}")


def _describe_damage(storage: Storage, folder: str, group: Any, name: str, *, may_be_nan: bool = True) -> str:
    """What is wrong with an array of inputs or of the base, in its folder; empty if nothing."""
    try:
        values = schema.read_input(storage, folder, group[name])
    except CorruptError as error:
        return f"chunk {str(error).rpartition('/')[2].replace(':', '')}"
    except UNREADABLE as error:
        return f"cannot be read: {plans.reason(error)}"
    return "" if may_be_nan or values.dtype.kind != "f" or np.isfinite(values).all() else "is not finite"


def _check_references(scene: CheckedScene, stored_plans: list[StoredPlan], inputs: PlannedContent) -> Iterator[Finding]:
    """Find rows and jobs out of sequence, and samples that refer to rows that hold nothing."""
    first_job = 0
    for plan in stored_plans:
        used = plan.rows.sample_modification != UNUSED
        wrong = used != (plan.rows.sample_view != UNUSED)
        for kind, references in (("modification", plan.rows.sample_modification), ("view", plan.rows.sample_view)):
            vectors = inputs.column(kind)
            within = used & (references >= 0) & (references < plan.end_row)
            wrong |= used & ~within
            wrong[within] |= np.isnan(vectors[references[within]]).any(axis=tuple(range(1, vectors.ndim)))
        if wrong.any():
            row = plan.first_row + int(np.argmax(wrong))
            detail = f"{np.count_nonzero(wrong)} samples refer to rows that hold no modification or view"
            yield scene.finding(Cause.PLAN, detail, plan.folder, row=row)
        if plan.first_job != first_job or plan.shard_rows != stored_plans[0].shard_rows:
            detail = f"begins at job {plan.first_job}; the plan before it ends at {first_job}"
            yield scene.finding(Cause.PLAN, detail, plan.folder)
        first_job = plan.end_job


def _check_keys(scene: CheckedScene, stored_plans: list[StoredPlan], inputs: PlannedContent) -> Iterator[Finding]:
    """Find samples whose content key does not match their content, or belongs to another sample as well."""
    modification, view = inputs.column("modification"), inputs.column("view")
    stored: list[bytes] = []
    for plan in stored_plans:
        rows = plan.rows
        used = np.flatnonzero(rows.sample_modification != UNUSED)
        contents = modification[rows.sample_modification[used]], view[rows.sample_view[used]]
        keys = sample_keys(scene.spec.radiance_id, *contents, rows.sample_pass[used])
        own = [key.tobytes() for key in rows.sample_key[used]]
        wrong = [plan.first_row + int(i) for i, key, kept in zip(used, keys, own, strict=True) if key != kept]
        if wrong:
            detail = f"{len(wrong)} samples have a key that is not of their modification, view and pass"
            yield scene.finding(Cause.PLAN, detail, f"{plan.folder}/sample_key", row=wrong[0])
        stored += own
    if repeated := len(stored) - len(set(stored)):
        yield scene.finding(Cause.PLAN, f"{repeated} keys are planned more than once", f"{scene.name}/plans")


# ----------------------------------------------------------------------------------------------------------------- base


def check_base(scene: CheckedScene, committed: Set[int]) -> list[Finding]:
    """What is wrong with geometry and base point cloud, which are there once a job is committed.

    Any job writes them when it is rendered: if they are missing and a planned job is still to come, workers repair
    that.
    """
    folder = f"{scene.name}/base"
    try:
        if scene.storage.exists(f"{folder}/zarr.json"):
            return list(_check_arrays_of_base(scene, folder))
        if not committed:
            return []
        waits = not scene.storage.names(folder) and not committed >= jobs_to_render(scene.plans or [])
        cause = Cause.BASE_TO_COME if waits else Cause.BASE
        return [scene.finding(cause, "is missing, and jobs are committed", folder)]
    except OSError as error:
        return [scene.unreadable(folder, error)]


def _check_arrays_of_base(scene: CheckedScene, folder: str) -> Iterator[Finding]:
    from photonfarm.store.format.metadata import open_group

    is_whole = True
    for part, arrays in declarations.BASE.items():
        try:
            parent = open_group(scene.storage, folder)[0][part]
        except (StoreError, *UNREADABLE) as error:
            is_whole = False
            yield scene.finding(Cause.BASE, f"cannot be read: {plans.reason(error)}", f"{folder}/{part}")
            continue
        for each in arrays:
            file = f"{folder}/{part}/{each.name}"
            if detail := _describe_damage(scene.storage, file, parent, each.name, may_be_nan=False):
                is_whole = False
                yield scene.finding(Cause.BASE, detail, file)
    if is_whole and (detail := _find_wrong_index(*read_base(scene.storage, scene.name), len(scene.spec.groups))):
        yield scene.finding(Cause.BASE, detail, folder)


def _find_wrong_index(geometry: Geometry, cloud: BasePointCloud, groups: int) -> str:
    """Which index is out of range; empty if none is."""
    limits: dict[str, tuple[NDArray[Any], int]] = {
        "geometry/faces": (geometry.faces, len(geometry.vertices)),
        "geometry/face_shape": (geometry.face_shape, len(geometry.shape_group)),
        "geometry/shape_group": (geometry.shape_group, groups),
        "cloud/group": (cloud.group, groups),
        "cloud/face": (cloud.face, len(geometry.faces)),
    }
    for name, (index, limit) in limits.items():
        if index.size and int(index.max()) >= limit:
            return f"{name} holds the index {int(index.max())}; {limit - 1} is the largest that is there"
    return ""


def jobs_to_render(stored_plans: list[StoredPlan]) -> set[int]:
    """All jobs of plans but the withdrawn ones."""
    return {job for plan in stored_plans for job in plan.own_jobs if job not in plan.withdrawn}


# ---------------------------------------------------------------------------------------------------------- other files


def find_unplanned_files(scene: CheckedScene) -> Iterator[Finding]:
    """Yield files of jobs that are not committed, and files that are not ours."""
    left: dict[int, str] = {}
    committed = f"{scene.name}/{markers.COMMITTED}"
    names = scene.storage.names(committed)
    foreign = [f"{committed}/{name}" for name in names if not re.fullmatch(r"\d+\.json", name)]
    for plan in scene.plans or []:
        for array in scene.arrays.values():
            folder = f"{plan.folder}/{array.name}"
            for name in sorted(set(scene.storage.names(folder)) - {"zarr.json"}):
                number = name.split(".")[1] if name.startswith("c.") else ""
                job = plan.first_job + int(number) if number.isdecimal() else plan.end_job
                if job >= plan.end_job or name != array.shard_name(job - plan.first_job):
                    foreign.append(f"{folder}/{name}")
                else:
                    left.setdefault(job, f"{folder}/{name}")
    for job in sorted(left.keys() - markers.list_jobs(scene.storage, scene.name)):  # now: a worker may have been at it
        yield scene.finding(Cause.NO_MARKER, "not a sample yet", left[job], job=job)
    yield from (scene.finding(Cause.FOREIGN_FILE, "left alone", file) for file in foreign)
