"""Reads what a scene's jobs are made from and refer to: its plans and its base.

Zarr reads a missing chunk as fill values, in silence; so the chunks are counted first.

Files that belong to no committed job are found here too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Set
from dataclasses import fields
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.plan.request import UNUSED, sample_keys
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.check.job_check import CheckTarget
from photonfarm.store.format import markers, schema
from photonfarm.store.io.storage import Storage
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Cause, Finding
from photonfarm.store.model.plans import StoredPlan
from photonfarm.store.model.scene_store import read_base

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, RuntimeError, FileNotFoundError)
"""What zarr-python raises for damaged metadata and chunks; a group in place of an array lacks its attributes."""


class PlanCheck:
    """Checks the plans and the base of one scene."""

    def __init__(self, storage: Storage, spec: SceneSpec, scene: str) -> None:
        self._storage = storage
        self._spec = spec
        self._scene = scene  # its folder
        self.shard_rows: int | None = None  # as the first readable plan states
        self.plans: list[StoredPlan] | None = None  # once checked; None if one is damaged
        self.lost: set[str] = set()  # folders of plans that are missing

    # ------------------------------------------------------------------------------------------------------------ plans

    def check_plans(self) -> Iterator[Finding]:
        """Yield what is wrong with the plans."""
        found: list[Finding] = []
        for number in range(plans.count(self._storage, self._scene)):
            folder = plans.folder(self._scene, number)
            try:
                found += self._plan(folder)
            except OSError as error:
                found.append(self._unreadable(folder, error))
        if not found:
            try:
                self.plans = plans.load_all(self._storage, self._scene, [])
            except StoreError as error:
                found.append(Finding(Cause.PLAN, str(error), self._id))
        yield from found
        if self.plans:
            references = list(self._references(self.plans))
            yield from references or self._keys(self.plans)
            self.plans = None if references else self.plans

    @property
    def _id(self) -> str:
        return self._spec.scene_id

    def _unreadable(self, folder: str, error: OSError) -> Finding:
        return Finding(Cause.UNREADABLE, error.strerror or str(error), self._id, file=folder)

    def _plan(self, folder: str) -> Iterator[Finding]:
        """Yield what is wrong with the files of a plan."""
        if not self._storage.exists(f"{folder}/zarr.json"):
            self.lost.add(folder)
            yield Finding(Cause.PLAN, findings.MISSING, self._id, file=f"{folder}/zarr.json")
            return
        try:
            group, about = plans.open_plan(self._storage, folder)
        except StoreError as error:
            yield Finding(Cause.PLAN, str(error).partition(": ")[2], self._id, file=f"{folder}/zarr.json")
            return
        self.shard_rows = self.shard_rows or about.shard_rows
        remedy = plans.rewritten(about.request)
        for name in plans.INPUTS:
            if detail := self._array(group, folder, name):
                yield Finding(Cause.PLAN_INPUTS, f"{detail}; {remedy}", self._id, file=f"{folder}/{name}")
        for file in about.checksums:
            name = file.partition("/")[0]
            if name not in (file, *plans.INPUTS) and (detail := declaration(group, name)):
                yield Finding(Cause.PLAN_INPUTS, f"{detail}; {remedy}", self._id, file=f"{folder}/{file}")

    def _array(self, group: Any, folder: str, name: str) -> str:
        """What is wrong with an array of inputs or of the base; empty if nothing."""
        try:
            values = schema.read_input(self._storage, f"{folder}/{name}", group[name])
        except CorruptError as error:
            return f"chunk {str(error).rpartition('/')[2].replace(':', '')}"
        except UNREADABLE as error:
            return f"cannot be read: {plans.reason(error)}"
        may_be_nan = name in plans.INPUTS or values.dtype.kind != "f"
        return "" if may_be_nan or np.isfinite(values).all() else "is not finite"

    def _references(self, found: list[StoredPlan]) -> Iterator[Finding]:
        """Find rows and jobs out of sequence, and samples that refer to rows that hold nothing."""
        modification, view = _stack(found)
        first_job = 0
        for plan in found:
            used = plan.rows.sample_modification != UNUSED
            wrong = used != (plan.rows.sample_view != UNUSED)
            for references, vectors in (
                (plan.rows.sample_modification, modification),
                (plan.rows.sample_view, view),
            ):
                within = used & (references >= 0) & (references < plan.end_row)
                wrong |= used & ~within
                wrong[within] |= np.isnan(vectors[references[within]]).any(axis=tuple(range(1, vectors.ndim)))
            if wrong.any():
                row = plan.first_row + int(np.argmax(wrong))
                detail = f"{np.count_nonzero(wrong)} samples refer to rows that hold no modification or view"
                yield Finding(Cause.PLAN, detail, self._id, row=row, file=plan.folder)
            if plan.first_job != first_job or plan.shard_rows != found[0].shard_rows:
                detail = f"begins at job {plan.first_job}; the plan before it ends at {first_job}"
                yield Finding(Cause.PLAN, detail, self._id, file=plan.folder)
            first_job = plan.end_job

    def _keys(self, found: list[StoredPlan]) -> Iterator[Finding]:
        """Find samples whose content key does not match their content, or belongs to another sample as well."""
        modification, view = _stack(found)
        for plan in found:
            rows = plan.rows
            used = np.flatnonzero(rows.sample_modification != UNUSED)
            contents = modification[rows.sample_modification[used]], view[rows.sample_view[used]]
            keys = sample_keys(self._spec.radiance_id, *contents, rows.sample_pass[used])
            stored = (rows.sample_key[i].tobytes() for i in used)
            wrong = [plan.first_row + int(i) for i, key, kept in zip(used, keys, stored, strict=True) if key != kept]
            if wrong:
                detail = f"{len(wrong)} samples have a key that is not of their modification, view and pass"
                yield Finding(Cause.PLAN, detail, self._id, row=wrong[0], file=f"{plan.folder}/sample_key")
        every = np.concatenate([plan.rows.sample_key[plan.rows.sample_modification != UNUSED] for plan in found])
        if repeated := len(every) - len(np.unique(every, axis=0)):
            detail = f"{repeated} keys are planned more than once"
            yield Finding(Cause.PLAN, detail, self._id, file=f"{self._scene}/plans")

    # ------------------------------------------------------------------------------------------------------------- base

    def check_base(self, committed: Set[int]) -> Iterator[Finding]:
        """Yield what is wrong with geometry and base point cloud, which are there once a job is committed.

        Any job writes them when it is rendered: if they are missing and a planned job is still to come, workers
        repair that.
        """
        folder = f"{self._scene}/base"
        try:
            yield from self._base(folder, committed)
        except OSError as error:
            yield self._unreadable(folder, error)

    def _base(self, folder: str, committed: Set[int]) -> Iterator[Finding]:
        from photonfarm.store.format.metadata import open_group

        if not self._storage.exists(f"{folder}/zarr.json"):
            if committed:
                wanted = jobs_to_render(self.plans or [])
                waits = not self._storage.names(folder) and not committed >= wanted
                cause = Cause.BASE_TO_COME if waits else Cause.BASE
                yield Finding(cause, "is missing, and jobs are committed", self._id, file=folder)
            return
        found = []
        for part, record in (("geometry", Geometry), ("cloud", BasePointCloud)):
            try:
                group, _ = open_group(self._storage, folder)
                names = [(field.name, group[part]) for field in fields(record)]
            except (StoreError, *UNREADABLE) as error:
                found.append(
                    Finding(Cause.BASE, f"cannot be read: {plans.reason(error)}", self._id, file=f"{folder}/{part}")
                )
                continue
            for name, parent in names:
                if detail := self._array(parent, f"{folder}/{part}", name):
                    found.append(Finding(Cause.BASE, detail, self._id, file=f"{folder}/{part}/{name}"))
        yield from found
        if not found and (detail := _base_references(*read_base(self._storage, self._scene), len(self._spec.groups))):
            yield Finding(Cause.BASE, detail, self._id, file=folder)


def jobs_to_render(found: list[StoredPlan]) -> set[int]:
    """All jobs of plans but the withdrawn ones."""
    return {job for plan in found for job in range(plan.first_job, plan.end_job) if job not in plan.withdrawn}


def declaration(group: Any, name: str) -> str:
    """What is wrong with the declaration of an array, by which other programs read it; empty if nothing."""
    try:
        _ = group[name]
    except UNREADABLE as error:
        return f"cannot be read: {plans.reason(error)}"
    return ""


def _stack(found: list[StoredPlan]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The modification vectors (R, G, 4) and view vectors (R, 6) of all rows of a scene."""
    return (
        np.concatenate([plan.rows.modification for plan in found]),
        np.concatenate([plan.rows.view for plan in found]),
    )


def _base_references(geometry: Geometry, cloud: BasePointCloud, groups: int) -> str:
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


def find_unplanned_files(scene: CheckTarget) -> Iterator[Finding]:
    """Yield files of jobs that are not committed, and files that are not ours."""
    left: dict[int, str] = {}
    foreign = [
        f"{scene.name}/{markers.COMMITTED}/{name}"
        for name in scene.storage.names(f"{scene.name}/{markers.COMMITTED}")
        if not re.fullmatch(r"\d+\.json", name)
    ]
    for folder, first_job, end_job, array in _array_folders(scene):
        for name in sorted(set(scene.storage.names(folder)) - {"zarr.json"}):
            number = name.split(".")[1] if name.startswith("c.") else ""
            job = first_job + int(number) if number.isdecimal() else end_job
            if job >= end_job or name != array.shard_name(job - first_job):
                foreign.append(f"{folder}/{name}")
            else:
                left.setdefault(job, f"{folder}/{name}")
    for job in sorted(left.keys() - markers.list_jobs(scene.storage, scene.name)):  # now: a worker may have been at it
        yield scene.finding(Cause.NO_MARKER, job, "not a sample yet", left[job])
    yield from (Finding(Cause.FOREIGN_FILE, "left alone", scene.scene_id, file=file) for file in foreign)


def _array_folders(scene: CheckTarget) -> Iterator[tuple[str, int, int, schema.ArraySchema]]:
    arrays = scene.arrays.values()
    return chain.from_iterable(
        ((f"{plan.folder}/{array.name}", plan.first_job, plan.end_job, array) for array in arrays)
        for plan in scene.plans or []
    )
