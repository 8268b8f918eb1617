"""Damaged inputs of a plan are written again: they are a function of its request and of the plans before it.

Those of a join are also one of the plans of the other store, and of which of its samples were complete then; those that
have come since are told by the keys of the damaged plan, if these are whole.

The rows of the request are trusted only if all arrays that can still be read agree with them bit by bit, and if these
determine each sample: by its content key, or by its references with the modifications and views.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, SpecError
from photonfarm.plan.request import Joined, PlannedRows, SamplesToPlan, expand_samples, samples_to_join
from photonfarm.store.check.plan_check import UNREADABLE, CheckedScene
from photonfarm.store.format import schema
from photonfarm.store.format.shards import crc_of
from photonfarm.store.io.storage import read_or_none
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Finding
from photonfarm.store.model.plans import PlanAttributes, StoredPlan
from photonfarm.store.model.quarantine import Quarantine
from photonfarm.store.model.store import Store

SETTLED_BY = ({"sample_key"}, {"sample_modification", "sample_view", "sample_pass", "modification", "view"})
"""The arrays each of which sets, if they are whole, determines every sample."""


class PlanRepair:
    """Writes damaged files of a scene's plans again, in their order, as later plans follow from earlier ones."""

    def __init__(self, scene: CheckedScene, quarantine: Quarantine, joined_from: Store | None) -> None:
        """Take the scene, the quarantine for damaged files, and a store that was joined."""
        self._scene = scene
        self._storage = scene.storage
        self._quarantine = quarantine
        self._joined_from = joined_from

    def run(self, number: int, why: Sequence[Finding]) -> None:
        """Write the damaged files of a plan again; its folder must have its zarr.json.

        Raises CorruptError if the request disagrees with what can still be read, if too little of that is left, or if
        an earlier plan is damaged.
        """
        before = plans.load_all(self._storage, self._scene.name, [], until=number)
        folder = plans.folder(self._scene.name, number)
        group, about = plans.open_plan(self._storage, folder)
        read = {name: values for name in plans.INPUTS if (values := self._read_whole(folder, group, name)) is not None}
        rows = self._expand(folder, about, before, read)
        for name, values in read.items():
            if values.tobytes() != getattr(rows, name).tobytes():
                raise self._hopeless(folder, f"its request gives another {name} than is there")
        if not any(needed <= read.keys() for needed in SETTLED_BY):
            raise self._hopeless(folder, "too little of it can be read to tell that its request gives the same")
        damaged = {str(finding.file).removeprefix(f"{folder}/").partition("/")[0] for finding in why}
        built = self._storage.part()
        try:
            first_job, shard_rows = about.first_job, about.shard_rows
            plans.build(built, self._scene.spec, about.request, rows, first_job=first_job, shard_rows=shard_rows)
            files = {path.relative_to(built).as_posix(): path for path in sorted(built.rglob("*")) if path.is_file()}
            wrong = {
                f"{folder}/{name}": path
                for name, path in files.items()
                if name.partition("/")[0] in damaged and self._differs(folder, name, path, about)
            }
            self._quarantine.rewrite(self._scene.name, number, wrong, why)
        finally:
            shutil.rmtree(built, ignore_errors=True)

    def _read_whole(self, folder: str, group: Any, name: str) -> NDArray[Any] | None:
        """An array of inputs; None if it is damaged."""
        try:
            return schema.read_input(self._storage, f"{folder}/{name}", group[name])
        except (CorruptError, *UNREADABLE):
            return None

    def _expand(
        self, folder: str, about: PlanAttributes, before: list[StoredPlan], read: dict[str, NDArray[Any]]
    ) -> PlannedRows:
        """The rows that the request gives after the earlier plans."""
        first_job = before[-1].end_job if before else 0
        if about.first_job != first_job or any(plan.shard_rows != about.shard_rows for plan in before):
            raise self._hopeless(folder, f"its zarr.json names job {about.first_job}; it begins at job {first_job}")
        numbers = {"first_job": first_job, "shard_rows": about.shard_rows}
        try:
            if isinstance(about.request, Joined):
                samples = self._samples_of_join(folder, about.request, before, read.get("sample_key"))
                rows = expand_samples(samples, **numbers).rows
            else:
                rows = plans.expand_request(self._scene.spec, about.request, before, **numbers).rows
        except (SpecError, ValueError) as error:
            raise self._hopeless(folder, f"its request cannot be expanded: {error}") from error
        if rows is None or len(rows.sample_key) != about.jobs * about.shard_rows:
            raise self._hopeless(folder, f"its request does not give its {about.jobs} jobs")
        return rows

    def _samples_of_join(
        self, folder: str, request: Joined, before: list[StoredPlan], keys: NDArray[Any] | None
    ) -> SamplesToPlan:
        """The samples of a plan of a join, from the other store; if its keys are whole, those with these alone."""
        other = self._joined_from
        if other is None or other.store_id != request.store:
            raise self._hopeless(folder, f"its rows are those of another store: {findings.rejoin(request.store)}")
        scene = other.scene(self._scene.scene_id)
        there = plans.content(scene.plans())
        rows = np.flatnonzero(plans.complete_rows(scene.plans(), scene.committed_jobs()))
        if keys is not None:
            planned = {key.tobytes() for key in keys}
            rows = rows[[key.tobytes() in planned for key in there.column("sample_key")[rows]]]
        return samples_to_join(there, rows, plans.content(before))

    def _differs(self, folder: str, name: str, built: Path, about: PlanAttributes) -> bool:
        """Whether a file is damaged or missing; CorruptError for a declaration that is built otherwise than stored."""
        from photonfarm.store.format.metadata import checksum

        content = read_or_none(self._storage, f"{folder}/{name}")
        if (right := about.checksums.get(name)) is None:
            return content is None or crc_of(content[:-4]) != content[-4:]  # a chunk has its checksum at its end
        if checksum(built.read_bytes()) != right:
            raise self._hopeless(folder, f"{folder}/{name}: this version writes other bytes")
        return content is None or checksum(content) != right

    def _hopeless(self, folder: str, why: str) -> CorruptError:
        return CorruptError(f"{self._storage.where}/{folder}: cannot be written again: {why}; {findings.RESTORE}")
