"""Damaged inputs of a plan are written again: they are a function of its request and of the plans before it.

Those of a join are also one of the plans of the other store, and of which of its samples were complete then; those that
have come since are told by the keys of the damaged plan, if these are whole.

The rows of the request are trusted only if all that can still be read agrees with them bit by bit, and if that
determines each sample: by its content key, or by its own row with those of its view and modification.

Shape letters: R rows of the plan.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numcodecs.blosc  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, SpecError
from photonfarm.plan.joined import Joined, samples_to_join
from photonfarm.plan.request import UNUSED, PlannedRows, SamplesToPlan, expand_samples
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format import declarations, schema
from photonfarm.store.format.declarations import ArrayDeclaration
from photonfarm.store.format.shards import crc_of
from photonfarm.store.io.storage import Storage, read_or_none
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Finding
from photonfarm.store.model.plans import PlanAttributes, StoredPlan
from photonfarm.store.model.quarantine import Quarantine
from photonfarm.store.model.store import Store

Mask = NDArray[np.bool_]

_CRC_BYTES = 4


class PlanRepair:
    """Writes damaged files of a scene's plans again, in their order, as later plans follow from earlier ones."""

    def __init__(
        self, storage: Storage, spec: SceneSpec, scene: str, quarantine: Quarantine, joined_from: Store | None
    ) -> None:
        """Take the scene, whose folder is `scene`, the quarantine for damaged files, and a store that was joined."""
        self._storage = storage
        self._spec = spec
        self._scene = scene
        self._quarantine = quarantine
        self._joined_from = joined_from

    def run(self, number: int, why: Sequence[Finding]) -> None:
        """Write the damaged files of a plan again; its folder must have its zarr.json.

        Raises CorruptError if the request disagrees with what can still be read, if too little of that is left, or if
        an earlier plan is damaged.
        """
        before = plans.load_all(self._storage, self._scene, [], until=number)
        folder = plans.folder(self._scene, number)
        _, about = plans.open_plan(self._storage, folder)
        rows = self._rows(folder, about, before)
        self._compare(folder, rows, about.first_job * about.shard_rows)
        found = {str(finding.file).removeprefix(f"{folder}/").partition("/")[0] for finding in why}
        built = self._storage.part()
        try:
            plans.build(built, self._spec, about.request, rows, first_job=about.first_job, shard_rows=about.shard_rows)
            files = {
                f"{folder}/{path.relative_to(built).as_posix()}": path
                for path in sorted(built.rglob("*"))
                if path.is_file() and path.relative_to(built).parts[0] in found
            }
            wrong = {name: path for name, path in files.items() if self._differs(folder, name, path, about.checksums)}
            self._quarantine.rewrite(self._scene, number, wrong, why)
        finally:
            shutil.rmtree(built, ignore_errors=True)

    def _rows(self, folder: str, about: PlanAttributes, before: list[StoredPlan]) -> PlannedRows:
        """The rows that the request gives after the earlier plans."""
        first_job = before[-1].end_job if before else 0
        if about.first_job != first_job or any(plan.shard_rows != about.shard_rows for plan in before):
            raise self._hopeless(folder, f"its zarr.json names job {about.first_job}; it begins at job {first_job}")
        numbers = {"first_job": first_job, "shard_rows": about.shard_rows}
        try:
            if isinstance(about.request, Joined):
                rows = expand_samples(self._samples(folder, about, about.request, before), **numbers).rows
            else:
                rows = plans.expand_again(self._spec, about.request, before, **numbers).rows
        except (SpecError, ValueError) as error:
            raise self._hopeless(folder, f"its request cannot be expanded: {error}") from error
        if rows is None or len(rows.sample_key) != about.jobs * about.shard_rows:
            raise self._hopeless(folder, f"its request does not give its {about.jobs} jobs")
        return rows

    def _samples(self, folder: str, about: PlanAttributes, request: Joined, before: list[StoredPlan]) -> SamplesToPlan:
        """The samples of a plan of a join, from the other store."""
        other = self._joined_from
        if other is None or other.store_id != request.store:
            raise self._hopeless(folder, f"its rows are those of another store: {findings.rejoin(request.store)}")
        scene = other.scene(self._spec.scene_id)
        there = plans.content(scene.plans())
        rows = np.flatnonzero(plans.complete_rows(scene.plans(), scene.committed_jobs()))
        empty = PlannedRows.empty(about.jobs * about.shard_rows, len(self._spec.groups)).sample_key
        declared = next(each for each in declarations.PLAN_INPUTS if each.name == "sample_key")
        chunks = [stored for _, stored in self._intact_chunks(folder, declared, empty)]
        keys = {key.tobytes() for stored in chunks for key in stored}
        if sum(map(len, chunks)) >= len(empty):
            rows = rows[[key.tobytes() in keys for key in there.column("sample_key")[rows]]]
        return samples_to_join(there, rows, plans.content(before))

    def _compare(self, folder: str, rows: PlannedRows, first_row: int) -> None:
        """Return if all readable inputs agree with these rows and determine every sample; else raise CorruptError."""
        read: dict[str, Mask] = {}
        for declared in declarations.PLAN_INPUTS:
            values = getattr(rows, declared.name)
            read[declared.name] = known = np.full(len(values), not values.size)
            for start, stored in self._intact_chunks(folder, declared, values):
                own = values[start : start + len(stored)]
                if own.tobytes() != stored[: len(own)].tobytes():
                    raise self._hopeless(folder, f"its request gives another {declared.name} than is there")
                known[start : start + len(own)] = True
        settled = read["sample_key"] | (
            read["sample_modification"]
            & read["sample_view"]
            & read["sample_pass"]
            & _read_known(rows.sample_modification, read["modification"], first_row)
            & _read_known(rows.sample_view, read["view"], first_row)
        )
        if not settled.all():
            raise self._hopeless(folder, "too little of it can be read to tell that its request gives the same")

    def _intact_chunks(
        self, folder: str, declared: ArrayDeclaration, values: NDArray[Any]
    ) -> Iterator[tuple[int, NDArray[Any]]]:
        """The chunks that are whole by their checksum, each with its first row; read without the array's zarr.json."""
        length = min(max(len(values), 1), schema.INPUT_ROWS_PER_CHUNK)
        for number in range(-(-len(values) // length) if values.size else 0):
            name = ".".join(["c", str(number), *("0" for _ in values.shape[1:])])
            content = read_or_none(self._storage, f"{folder}/{declared.name}/{name}")
            if content is None or not _is_whole(content):
                continue
            try:
                data = numcodecs.blosc.decompress(content[:-_CRC_BYTES])
                stored = np.frombuffer(data, declared.dtype).reshape(length, *values.shape[1:])
            except (ValueError, RuntimeError) as error:
                raise self._hopeless(folder, f"{declared.name}/{name} is whole, and no chunk of this plan") from error
            yield number * length, stored

    def _differs(self, folder: str, name: str, built: Path, checksums: Mapping[str, str]) -> bool:
        """Whether a file is damaged or missing; CorruptError for a declaration that is built otherwise than stored."""
        from photonfarm.store.format.metadata import checksum

        content = read_or_none(self._storage, name)
        if (right := checksums.get(name.removeprefix(f"{folder}/"))) is None:
            return content is None or not _is_whole(content)
        if checksum(built.read_bytes()) != right:
            raise self._hopeless(folder, f"{name}: this version writes other bytes")
        return content is None or checksum(content) != right

    def _hopeless(self, folder: str, why: str) -> CorruptError:
        return CorruptError(f"{self._storage.where}/{folder}: cannot be written again: {why}; {findings.RESTORE}")


def _is_whole(content: bytes) -> bool:
    """Whether a chunk's checksum, at its end, is that of its bytes."""
    return crc_of(content[:-_CRC_BYTES]) == content[-_CRC_BYTES:]


def _read_known(references: NDArray[np.int64], own: Mask, first_row: int) -> Mask:
    """Whether the rows (R,) that samples refer to are known: they were read, are of older plans, or are unused."""
    known = references < first_row
    known[~known] = own[references[~known] - first_row]
    return known | (references == UNUSED)
