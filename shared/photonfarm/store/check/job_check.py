"""Reads everything that one committed job stored: its marker, its files, each of their rows.

Samples that have a half in common are found here too. Seeds have 32 bits, so that among many samples some have one in
common by chance. Such samples would be equal again when rendered again, so they are distinguished from those that a
fault has made.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError
from photonfarm.core.keys import seed_of
from photonfarm.scene.poor_views import are_near, hand_of
from photonfarm.store.check.content_check import (
    CheckTotals,
    HalvesTest,
    check_bits,
    check_radiance,
    check_view,
    is_constant,
    is_finite,
)
from photonfarm.store.check.plan_check import CheckedScene
from photonfarm.store.format import markers
from photonfarm.store.format.schema import RowKind
from photonfarm.store.format.shards import Shard
from photonfarm.store.model import findings, plans
from photonfarm.store.model.findings import Cause, Finding
from photonfarm.store.model.plans import JobRows

KINDS: tuple[RowKind, ...] = ("sample", "view", "modification")

DRAWN = 4
"""The number of seeds that a renderer may draw for a half: three are tried, and one may be the other half's."""

Checked = tuple[list[Finding], bytes, CheckTotals]
"""What is found of a job, its marker, and the totals of what was read."""


def check_job(scene: CheckedScene, scenes: int, job: int) -> Checked:
    """Check a job, one of several scenes; damaged copies of this machine are replaced and read again first."""
    checked = _JobCheck(scene, scenes, job).run()
    damaged = {finding.file for finding in checked[0] if finding.cause is Cause.CHECKSUM and finding.file}
    renewed = [scene.storage.renew(file) for file in sorted(damaged)]
    if any(renewed):
        return _JobCheck(scene, scenes, job).run()
    return checked


class _JobCheck:
    """One job that is being checked."""

    def __init__(self, scene: CheckedScene, scenes: int, job: int) -> None:
        self._scene, self._job, self._shard_rows = scene, job, scene.shard_rows or 0
        self._marker_name = markers.marker_name(scene.name, job)
        self._totals = CheckTotals(HalvesTest(scenes))
        self._shards: dict[str, Shard] = {}  # by array: those that could be opened

    def run(self) -> Checked:
        """The findings, nothing if the marker is removed in the meantime."""
        storage, name = self._scene.storage, self._marker_name
        try:
            marker = storage.read(name)
            findings = list(self._check(marker))
            if not findings or storage.read(name) == marker:
                return findings, marker, self._totals
        except FileNotFoundError:
            pass
        except OSError as error:
            return [self._scene.unreadable(name, error, self._job)], b"", self._totals
        return [], b"", self._totals

    def _finding(self, cause: Cause, detail: str, file: str | None = None, row: int | None = None) -> Finding:
        return self._scene.finding(cause, detail, file, job=self._job, row=row)

    def _check(self, marker: bytes) -> Iterator[Finding]:
        scene = self._scene
        own = scene.files_of(self._job)
        if scene.plans is not None and not own:
            yield self._without_plan(marker)
            return
        try:
            named = markers.parse_files(marker, scene.name, self._job)
        except CorruptError as error:
            yield self._finding(Cause.MARKER, _error_text(error), self._marker_name)
            return
        files = {file: about for file, about in named.items() if _array_of(file) in scene.arrays}  # others may be added
        self._totals.jobs += 1
        for file, about in files.items():
            yield from self._open(file, about)
        rows = None if scene.plans is None else plans.job_rows(scene.plans, self._job)
        if rows is not None:
            yield from self._against_plan(rows, files, own)
        for kind in KINDS:
            yield from self._check_rows(kind, {_array_of(file): file for file in files}, rows)

    def _without_plan(self, marker: bytes) -> Finding:
        """The finding for a marker without a plan: the last plan is missing if the marker names files in its folder."""
        scene = self._scene
        with contextlib.suppress(CorruptError):
            named = {_plan_of(file) for file in markers.parse_files(marker, scene.name, self._job)}
            if missing := named - {plan.folder for plan in scene.plans or []}:
                return self._finding(Cause.PLAN, findings.MISSING, f"{min(missing)}/zarr.json")
        return self._finding(Cause.NO_PLAN, "no plan has this job", self._marker_name)

    # ------------------------------------------------------------------------------------------------------------ files

    def _open(self, file: str, about: dict[str, Any]) -> Iterator[Finding]:
        """Open a file that the marker names, and compare it with the marker."""
        array, storage = self._scene.arrays[_array_of(file)], self._scene.storage
        try:
            size = storage.size(file)
            self._totals.size_bytes += size
            if size != about["size"]:
                yield self._finding(Cause.SIZE, f"has {size} bytes; {about['size']} were committed", file)
                return
            shard = Shard(storage.local(file), array, self._shard_rows)
            crc32c = shard.summary()["crc32c"]
        except (FileNotFoundError, NotADirectoryError):
            if _plan_of(file) not in self._scene.lost:  # without its plan it cannot be rendered again
                yield self._finding(Cause.MISSING_FILE, "the marker names it", file)
            return
        except CorruptError as error:
            yield self._finding(Cause.CHECKSUM, _error_text(error), file)
            return
        except OSError as error:
            yield self._scene.unreadable(file, error, self._job)
            return
        self._shards[array.name] = shard
        if crc32c != about["crc32c"]:
            detail = f"its checksums have the CRC-32C {crc32c}; {about['crc32c']} was committed"
            yield self._finding(Cause.CHECKSUM, detail, file)

    def _against_plan(self, rows: JobRows, files: dict[str, dict[str, Any]], own: dict[str, str]) -> Iterator[Finding]:
        """Find rows that the plan requires and the files lack, and rows that the files hold and the plan lacks."""
        for file in sorted(files.keys() - own.values()):
            yield self._finding(Cause.MARKER, "the marker names it, but it belongs to another job", file)
        for file in sorted(own.values() - files.keys()):
            if self._scene.storage.exists(file):
                yield self._finding(Cause.FOREIGN_FILE, "is there, and the job's marker does not name it", file)
        wanted, every = rows.wanted(), range(self._shard_rows)
        first = self._job * self._shard_rows
        held = {name: {first + i for i in every if i in shard} for name, shard in self._shards.items()}
        unread = {name for name, file in own.items() if file in files and name not in self._shards}  # found already
        for name, array in self._scene.arrays.items():
            for row in sorted(held.get(name, set()) - wanted[array.kind]):
                yield self._finding(Cause.UNUSED_ROW, "the plan has no such row", own[name], row)
            if array.kind != "sample" and name not in unread:
                for row in sorted(wanted[array.kind] - held.get(name, set())):
                    yield self._finding(Cause.MISSING_ROW, "the plan has it", own[name], row)
        narrow, wide = held.get("radiance", set()), held.get("radiance_wide", set())  # either may lack some samples
        for row in sorted(narrow & wide & wanted["sample"]):
            yield self._finding(Cause.TWICE, "radiance has it already", own["radiance_wide"], row)
        if not unread & {"radiance", "radiance_wide"}:
            for row in sorted(wanted["sample"] - narrow - wide):
                yield self._finding(Cause.MISSING_ROW, "radiance_wide lacks it too", own["radiance"], row)

    # ------------------------------------------------------------------------------------------------------------- rows

    def _check_rows(self, kind: RowKind, files: dict[str, str], rows: JobRows | None) -> Iterator[Finding]:
        """Read every row of a kind, and check the values of undamaged rows."""
        for i in range(self._shard_rows):
            row, values = self._job * self._shard_rows + i, {}
            for name, shard in self._shards.items():
                if self._scene.arrays[name].kind != kind:
                    continue
                try:
                    read = shard.read(i)
                except CorruptError as error:
                    yield self._finding(Cause.CHECKSUM, _error_text(error), files[name], row)
                    continue
                if read is not None and read.dtype.kind == "f" and not is_finite(read):
                    yield self._finding(Cause.NOT_FINITE, name, files[name], row)
                elif read is not None:
                    values[name] = read
            for cause, detail in self._check_values(row, values, rows):
                yield self._finding(cause, detail, row=row)

    def _check_values(
        self, row: int, values: dict[str, NDArray[Any]], rows: JobRows | None
    ) -> Iterator[tuple[Cause, str]]:
        halves = values.get("radiance", values.get("radiance_wide"))
        if halves is not None:
            yield from check_radiance(row, halves, self._totals)
        if "depth" in values and "normal" in values:
            view = None if rows is None else rows.views.get(row)
            yield from check_view(values["depth"], values["normal"], view, self._scene.spec)
            self._totals.counts.update(views=1, near=int(are_near(hand_of(self._scene.spec), values["depth"])))
        for name in ("point_seen", "photon_seen"):
            if name in values:
                yield from check_bits(name, values[name], self._scene.spec)


def _array_of(file: str) -> str:
    """The array that a file named by a marker belongs to."""
    return file.rsplit("/", 2)[1]


def _plan_of(file: str) -> str:
    """The folder of the plan that a file of an output lies in."""
    return file.rsplit("/", 2)[0]


def _error_text(error: CorruptError) -> str:
    """The text of an error without the file, which the finding names."""
    return str(error).partition(": ")[2] or str(error)


# -------------------------------------------------------------------------------------------- samples of several jobs


def find_equal_samples(scene: CheckedScene, totals: CheckTotals) -> Iterator[Finding]:
    """Samples that have a half in common. Constant halves may rightly be equal: there is no noise in them."""
    for rows in totals.fingerprints.suspects():
        read = ((row, halves) for row in rows if (halves := _read_halves(scene, row)) is not None)
        first, reference = next(read, (0, None))
        if reference is None or any(is_constant(half) for half in reference):
            continue
        causes = {
            row: Cause.SAME_SEED if _seeds(scene, row) & _seeds(scene, first) else Cause.EQUAL_SAMPLES
            for row, halves in read
            if any(np.array_equal(a, b) for a in reference for b in halves)
        }
        pairs = [(cause, row, first) for row, cause in causes.items()]
        pairs += [(cause, first, max(row for row in causes if causes[row] is cause)) for cause in set(causes.values())]
        for cause, row, other in pairs:
            detail = f"has a half in common with row {other}"
            yield scene.finding(cause, detail, job=row // (scene.shard_rows or 1), row=row)


def _seeds(scene: CheckedScene, row: int) -> set[int]:
    """The seeds that the halves of a sample may have been rendered with, by its key; none without a plan."""
    sample = plans.sample_at(scene.plans, row) if scene.plans else None
    if sample is None:
        return set()
    purposes = [f"half {half}{again}" for half in "AB" for again in ("", *(f", attempt {n}" for n in range(1, DRAWN)))]
    return {seed_of(sample.key, purpose) for purpose in purposes}


def _read_halves(scene: CheckedScene, row: int) -> NDArray[np.floating] | None:
    """The stored halves of a row; None if they cannot be read (any more)."""
    shard_rows = scene.shard_rows or 1
    files = scene.files_of(row // shard_rows)
    for name in ("radiance", "radiance_wide"):
        if name in files and scene.storage.exists(files[name]):
            try:
                shard = Shard(scene.storage.local(files[name]), scene.arrays[name], shard_rows)
                halves = shard.read(row % shard_rows)
            except CorruptError:  # found already, or set aside in the meantime
                return None
            if halves is not None:
                return halves
    return None
