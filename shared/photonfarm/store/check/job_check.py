"""Reads everything that one committed job stored: its marker, its files, each of their rows."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.check.content_check import CheckTotals, ContentCheck, is_finite
from photonfarm.store.format import markers, schema
from photonfarm.store.format.shards import Shard
from photonfarm.store.io.storage import Storage
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Cause, Finding
from photonfarm.store.model.plans import JobRows, StoredPlan

KINDS: tuple[schema.RowKind, ...] = ("sample", "view", "modification")


@dataclass(frozen=True, slots=True, eq=False)
class CheckTarget:
    """A scene that is being checked."""

    storage: Storage
    scene_id: str
    name: str  # of its folder
    spec: SceneSpec
    plans: list[StoredPlan] | None  # None if one is damaged: then only what markers state can be checked
    shard_rows: int
    lost: frozenset[str] = frozenset()  # folders of plans that are missing

    @property
    def arrays(self) -> Mapping[str, schema.ArraySchema]:
        """The arrays that jobs store there, by name."""
        return schema.output_arrays(self.spec)

    def wanted(self, rows: JobRows) -> dict[schema.RowKind, Set[int]]:
        """The rows that a job stores of each kind."""
        samples = {sample.row for sample in rows.samples}
        return {"sample": samples, "view": rows.new_views, "modification": rows.new_modifications}

    def finding(self, cause: Cause, job: int, detail: str, file: str | None = None, row: int | None = None) -> Finding:
        """A finding about a job."""
        return Finding(cause, detail, self.scene_id, job, row, file)

    def files_of(self, job: int) -> dict[str, str]:
        """The names that a job's files may have, by array; empty for a job of no known plan."""
        for plan in self.plans or []:
            if plan.first_job <= job < plan.end_job:
                return {name: plan.shard(name, array, job) for name, array in self.arrays.items()}
        return {}


class JobCheck:
    """Checks jobs of a scene one after the other, with the same memory for each."""

    def __init__(self, scene: CheckTarget) -> None:
        self._scene = scene
        self._finding = scene.finding
        self._arrays = scene.arrays
        self._memory = {name: np.empty(array.shape, array.dtype) for name, array in self._arrays.items()}
        self._contents = ContentCheck(scene.spec)

    def run(self, job: int, totals: CheckTotals) -> tuple[list[Finding], bytes]:
        """The findings of a job, and its marker; nothing if the marker is removed in the meantime.

        The totals of the job are added to `totals`.
        """
        self._totals = totals
        storage, name = self._scene.storage, markers.marker_name(self._scene.name, job)
        try:
            content = storage.read(name)
        except FileNotFoundError:
            return [], b""
        except OSError as error:
            return [self._unreadable(job, name, error)], b""
        try:
            found = list(self._of(job, content))
            if not found or storage.read(name) == content:
                return found, content
        except FileNotFoundError:
            pass
        return [], b""

    def _of(self, job: int, marker: bytes) -> Iterator[Finding]:
        scene, name = self._scene, markers.marker_name(self._scene.name, job)
        own = scene.files_of(job)
        if scene.plans is not None and not own:
            yield self._without_plan(job, marker, name)
            return
        try:
            named = markers.parse_files(marker, scene.name, job)
        except CorruptError as error:
            yield self._finding(Cause.MARKER, job, _error_text(error), name)
            return
        files = {file: about for file, about in named.items() if _array_of(file) in self._arrays}  # others may be added
        self._totals.jobs += 1
        shards: dict[str, Shard] = {}
        for file, about in files.items():
            yield from self._open(job, file, about, shards)
        rows = None if scene.plans is None else plans.job_rows(scene.plans, job)
        if rows is not None:
            yield from self._against_plan(rows, files, own, shards)
        for kind in KINDS:
            yield from self._rows(job, kind, files, shards, rows)

    def _without_plan(self, job: int, marker: bytes, name: str) -> Finding:
        """The finding for a marker without a plan: the last plan is missing if the marker names files in its folder."""
        scene = self._scene
        with contextlib.suppress(CorruptError):
            named = {_plan_of(file) for file in markers.parse_files(marker, scene.name, job)}
            if missing := named - {plan.folder for plan in scene.plans or []}:
                return self._finding(Cause.PLAN, job, findings.MISSING, f"{min(missing)}/zarr.json")
        return self._finding(Cause.NO_PLAN, job, "no plan has this job", name)

    # ------------------------------------------------------------------------------------------------------------ files

    def _open(self, job: int, file: str, about: dict[str, Any], shards: dict[str, Shard]) -> Iterator[Finding]:
        """Open a file that the marker names, by its array, and compare it with the marker."""
        array = self._arrays[_array_of(file)]
        try:
            size = self._scene.storage.size(file)
        except (FileNotFoundError, NotADirectoryError):
            if _plan_of(file) not in self._scene.lost:  # without its plan it cannot be rendered again
                yield self._finding(Cause.MISSING_FILE, job, "the marker names it", file)
            return
        except OSError as error:
            yield self._unreadable(job, file, error)
            return
        self._totals.size_bytes += size
        if size != about["size"]:
            yield self._finding(Cause.SIZE, job, f"has {size} bytes; {about['size']} were committed", file)
            return
        try:
            shard = Shard(self._scene.storage.local(file), array, self._scene.shard_rows)
            crc32c = shard.summary()["crc32c"]
        except CorruptError as error:
            yield self._finding(Cause.CHECKSUM, job, _error_text(error), file)
            return
        except OSError as error:
            yield self._unreadable(job, file, error)
            return
        shards[array.name] = shard
        if crc32c != about["crc32c"]:
            detail = f"its checksums have the CRC-32C {crc32c}; {about['crc32c']} was committed"
            yield self._finding(Cause.CHECKSUM, job, detail, file)

    def _against_plan(
        self, rows: JobRows, files: dict[str, dict[str, Any]], own: dict[str, str], shards: dict[str, Shard]
    ) -> Iterator[Finding]:
        """Find rows that the plan requires and the files lack, and rows that the files hold and the plan lacks."""
        for file in sorted(files.keys() - own.values()):
            yield self._finding(Cause.MARKER, rows.job, "the marker names it, but it belongs to another job", file)
        for file in sorted(own.values() - files.keys()):
            if self._scene.storage.exists(file):
                yield self._finding(
                    Cause.FOREIGN_FILE, rows.job, "is there, and the job's marker does not name it", file
                )
        wanted = self._scene.wanted(rows)
        held = {name: self._held(rows.job, shard) for name, shard in shards.items()}
        unread = {name for name, file in own.items() if file in files and name not in shards}  # found already
        for name, array in self._arrays.items():
            for row in sorted(held.get(name, set()) - wanted[array.kind]):
                yield self._finding(Cause.UNUSED_ROW, rows.job, "the plan has no such row", own[name], row)
            if array.kind != "sample" and name not in unread:
                for row in sorted(wanted[array.kind] - held.get(name, set())):
                    yield self._finding(Cause.MISSING_ROW, rows.job, "the plan has it", own[name], row)
        yield from self._of_radiance(rows.job, wanted["sample"], own, held, unread)

    def _of_radiance(
        self, job: int, samples: Set[int], own: dict[str, str], held: dict[str, set[int]], unread: set[str]
    ) -> Iterator[Finding]:
        """Find samples that are in both radiance arrays or in neither; either array may lack some samples."""
        narrow, wide = held.get("radiance", set()), held.get("radiance_wide", set())
        for row in sorted(narrow & wide & samples):
            yield self._finding(Cause.TWICE, job, "radiance has it already", own["radiance_wide"], row)
        if not unread & {"radiance", "radiance_wide"}:
            for row in sorted(samples - narrow - wide):
                yield self._finding(Cause.MISSING_ROW, job, "radiance_wide lacks it too", own["radiance"], row)

    def _held(self, job: int, shard: Shard) -> set[int]:
        first = job * self._scene.shard_rows
        return {first + i for i in range(self._scene.shard_rows) if i in shard}

    # ------------------------------------------------------------------------------------------------------------- rows

    def _rows(
        self,
        job: int,
        kind: schema.RowKind,
        files: dict[str, dict[str, Any]],
        shards: dict[str, Shard],
        rows: JobRows | None,
    ) -> Iterator[Finding]:
        """Read every row of a kind, and check the values of undamaged rows."""
        names = {_array_of(file): file for file in files}
        for i in range(self._scene.shard_rows):
            row, values = job * self._scene.shard_rows + i, {}
            for name in (name for name, shard in shards.items() if self._arrays[name].kind == kind and i in shard):
                if fault := self._read(shards[name], name, i):
                    yield self._finding(fault[0], job, fault[1], names[name], row)
                else:
                    values[name] = self._memory[name]
            for cause, detail in self._content(row, values, rows):
                yield self._finding(cause, job, detail, row=row)

    def _read(self, shard: Shard, name: str, i: int) -> tuple[Cause, str] | None:
        """Read a row into the array's memory; returns what is wrong with it, if anything."""
        values = self._memory[name]
        try:
            shard.read_into(i, values)
        except CorruptError as error:
            return Cause.CHECKSUM, _error_text(error)
        if values.dtype.kind == "f" and not is_finite(values):
            return Cause.NOT_FINITE, name
        return None

    def _content(self, row: int, values: dict[str, NDArray[Any]], rows: JobRows | None) -> Iterator[tuple[Cause, str]]:
        halves = values.get("radiance", values.get("radiance_wide"))
        if halves is not None:
            yield from self._contents.radiance(row, halves, self._totals)
        if "depth" in values and "normal" in values:
            view = None if rows is None else rows.views.get(row)
            yield from self._contents.view(values["depth"], values["normal"], view, self._totals)
        for name in ("point_seen", "photon_seen"):
            if name in values:
                yield from self._contents.bits(name, values[name])

    def _unreadable(self, job: int, file: str, error: OSError) -> Finding:
        """The finding for a file that cannot be read; raises OSError if the whole store cannot be read."""
        self._scene.storage.names(self._scene.name)
        return self._finding(Cause.UNREADABLE, job, error.strerror or str(error), file)


def _array_of(file: str) -> str:
    """The array that a file named by a marker belongs to."""
    return file.rsplit("/", 2)[1]


def _plan_of(file: str) -> str:
    """The folder of the plan that a file of an output lies in."""
    return file.rsplit("/", 2)[0]


def _error_text(error: CorruptError) -> str:
    """The text of an error without the file, which the finding names."""
    return str(error).partition(": ")[2] or str(error)
