"""The store as those see it who plan and render: scenes, plans, jobs, commits.

Plans and markers are the truth. Nothing here needs a lock: a name appears once, by link or rename, and the first one
stays. Safe for any number of processes and machines on one POSIX file system.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Iterator, Mapping, Set
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from photonfarm.shared.errors import CorruptError, IncompleteError, SpecError, StoreError
from photonfarm.shared.plan import MAX_SHARD_ROWS, SHARD_ROWS, Known, Request, expand
from photonfarm.shared.records import F32, BasePointCloud, Geometry, Photons, ViewBuffers, arrays_of
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store import durable, plans, schema, shards
from photonfarm.shared.store.durable import store_errors
from photonfarm.shared.store.plans import JobRows, StoredPlan

FORMAT_FILE = "photonfarm.json"


@dataclass(frozen=True, slots=True)
class PlanResult:
    """What became of a request."""

    scene_id: str
    plan: int | None  # number of the new plan; None if nothing was new, or nothing was written
    new: int  # samples planned now
    known: int  # samples of the request that older plans hold
    jobs: int  # jobs of the new plan


@dataclass(frozen=True, slots=True)
class Figures:
    """What a job cost and how it went; kept in its marker."""

    core_s: float  # processor time, all threads
    wall_s: float
    redrawn: int  # renders thrown away for a non-finite value, and drawn again with another seed
    worker: str
    versions: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a scene is, in samples."""

    planned_samples: int
    committed_samples: int  # complete ones


@dataclass(frozen=True, slots=True, eq=False)
class JobOutputs:
    """Everything a job has rendered, by row number."""

    radiance: dict[int, F32]  # sample rows → (2, H, W, 3), linear, unscaled; halves A and B
    buffers: dict[int, ViewBuffers]  # the job's new view rows
    photons: dict[int, Photons]  # the job's new modification rows; empty for a scene without photons


class Store:
    """A sample store in a folder; holds any number of scenes."""

    def __init__(self, root: str | Path, *, create: bool = False) -> None:
        """Open a store, or make one where there is none; raises StoreError if that cannot be."""
        self.root = Path(root)
        self._opened: dict[str, SceneStore] = {}
        if create:
            self._create()
        self._check_format()

    def _create(self) -> None:
        with store_errors("make a store here", self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            foreign = [path.name for path in self.root.iterdir() if path.name not in (FORMAT_FILE, "scenes", "tmp")]
            if foreign and not (self.root / FORMAT_FILE).exists():
                raise StoreError(f"{self.root}: is neither empty nor a store (it holds {foreign[0]!r})")
            if not (self.root / FORMAT_FILE).exists():  # before all else: who looks in between must find a store
                document = {"format": schema.FORMAT, "version": schema.VERSION}
                durable.place_json(document, self.root / FORMAT_FILE, self.root / "tmp")
            self._scenes.mkdir(exist_ok=True)

    def _check_format(self) -> None:
        file = self.root / FORMAT_FILE
        try:
            document = json.loads(file.read_text())
            name, version = document["format"], document["version"]
        except FileNotFoundError as error:
            raise StoreError(f"{self.root}: is not a store: {FORMAT_FILE} is missing") from error
        except OSError as error:
            raise StoreError(f"{self.root}: cannot be read: {error.strerror}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise CorruptError(f"{file}: is not the document of a store: {error}") from error
        if name != schema.FORMAT or version != schema.VERSION:
            raise StoreError(
                f"{self.root}: has format {name!r} version {version!r}; this program reads and writes "
                f"{schema.FORMAT!r} version {schema.VERSION}"
            )

    @property
    def _scenes(self) -> Path:
        return self.root / "scenes"

    def scene_ids(self) -> list[str]:
        """The scenes that are there, in order of their ids."""
        with store_errors("list the scenes", self._scenes), contextlib.suppress(FileNotFoundError):
            return sorted(path.name for path in self._scenes.iterdir() if (path / "spec.json").is_file())
        return []

    def scene(self, scene_id: str) -> SceneStore:
        """One scene of the store, the same object each time; raises StoreError if it is not there."""
        if scene_id not in self._opened:
            self._opened[scene_id] = SceneStore(self._scenes / scene_id)
        return self._opened[scene_id]

    def scenes(self, only: str | None = None) -> list[SceneStore]:
        """Every scene of the store, or the one that is named; raises StoreError if that is not there."""
        return [self.scene(scene_id) for scene_id in (self.scene_ids() if only is None else [only])]

    def add(self, spec: SceneSpec) -> SceneStore:
        """The scene of a spec, made if it is new; the first spec written for a scene id stays."""
        folder = self._scenes / spec.scene_id
        with store_errors("add a scene", folder):
            if not (folder / "spec.json").exists():
                folder.mkdir(parents=True, exist_ok=True)
                durable.place_json(spec.model_dump(mode="json"), folder / "spec.json", folder / "tmp")
                durable.sync_folder(self._scenes)
        return self.scene(spec.scene_id)

    def plan(
        self, spec: SceneSpec, request: Request, *, shard_rows: int | None = None, dry_run: bool = False
    ) -> PlanResult:
        """Plan what is new of a request; `dry_run` only counts. `shard_rows` is fixed by a scene's first plan."""
        if dry_run and spec.scene_id not in self.scene_ids():
            expansion = expand(spec, request, Known(), first_job=0, shard_rows=shard_rows or SHARD_ROWS)
            return PlanResult(spec.scene_id, None, expansion.new, expansion.known, 0)
        return self.add(spec).plan(request, shard_rows=shard_rows, dry_run=dry_run)

    def sweep(self, *, stray_age_s: float = durable.STRAY_AGE_S) -> int:
        """Remove temporary files that dead writers left; how many."""
        with store_errors("sweep temporary files", self.root):
            folders = [self.root / "tmp", *(self._scenes / scene_id / "tmp" for scene_id in self.scene_ids())]
            return sum(durable.sweep(tmp, now_s=time.time(), stray_age_s=stray_age_s) for tmp in folders)


class SceneStore:
    """One scene of a store: its spec, base, plans, jobs and markers."""

    def __init__(self, folder: Path) -> None:
        """Open; raises StoreError if there is no such scene."""
        self.folder = folder
        self.spec = read_spec(folder)
        self._plans: list[StoredPlan] = []

    @property
    def scene_id(self) -> str:
        """The scene's id, which is its folder's name."""
        return self.folder.name

    @property
    def _tmp(self) -> Path:
        return self.folder / "tmp"

    # ------------------------------------------------------------------------------------------------------------ plans

    def plans(self) -> list[StoredPlan]:
        """The plans that are there by now, in order."""
        self._plans = load_plans(self.folder, self._plans)
        return self._plans

    def plan(self, request: Request, *, shard_rows: int | None = None, dry_run: bool = False) -> PlanResult:
        """Plan what is new of a request; racing submitters try again, each against the other's plan."""
        while True:
            found = self.plans()
            rows_per_job = self._shard_rows(found, shard_rows)
            first_job = found[-1].first_job + found[-1].jobs if found else 0
            known = Known()
            for plan in found:
                known.add(plan.rows, plan.first_row)
            expansion = expand(self.spec, request, known, first_job=first_job, shard_rows=rows_per_job)
            if expansion.rows is None or dry_run:
                return PlanResult(self.scene_id, None, expansion.new, expansion.known, 0)
            with store_errors("write a plan", self.folder):
                built = durable.temporary(self._tmp)
                try:
                    plans.build(built, self.spec, request, expansion.rows, first_job=first_job, shard_rows=rows_per_job)
                    if durable.place_folder(built, self.folder / "plans" / plans.folder_name(len(found))):
                        jobs = len(expansion.rows.sample_pass) // rows_per_job
                        return PlanResult(self.scene_id, len(found), expansion.new, expansion.known, jobs)
                finally:
                    shutil.rmtree(built, ignore_errors=True)

    def _shard_rows(self, found: list[StoredPlan], wanted: int | None) -> int:
        if wanted is not None and not 1 <= wanted <= MAX_SHARD_ROWS:
            raise SpecError(f"shard_rows = {wanted}: 1 to {MAX_SHARD_ROWS} samples per job are allowed")
        if not found:
            return wanted or SHARD_ROWS
        if wanted not in (None, found[0].shard_rows):
            raise SpecError(
                f"shard_rows = {wanted}: scene {self.scene_id} has {found[0].shard_rows} samples per job, fixed by its "
                "first plan; leave the setting out"
            )
        return found[0].shard_rows

    # ------------------------------------------------------------------------------------------------------------- jobs

    def job_rows(self, job: int) -> JobRows:
        """What a job must produce, with its inputs; raises IndexError for a job of no plan."""
        if not any(plan.first_job <= job < plan.first_job + plan.jobs for plan in self._plans):
            self.plans()
        return plans.job_rows(self._plans, job)

    def jobs(self) -> int:
        """How many jobs are planned; they are numbered from 0."""
        found = self.plans()
        return found[-1].first_job + found[-1].jobs if found else 0

    def committed_jobs(self) -> set[int]:
        """The jobs that have their marker."""
        return committed_jobs(self.folder)

    def missing_jobs(self) -> list[int]:
        """The jobs that are planned and not committed, in order."""
        committed = self.committed_jobs()
        return [job for job in range(self.jobs()) if job not in committed]

    def is_committed(self, job: int) -> bool:
        """Whether a job has its marker."""
        return marker_path(self.folder, job).exists()

    def marker(self, job: int) -> dict[str, Any]:
        """The marker of a committed job: its files and its figures."""
        path = marker_path(self.folder, job)
        try:
            return json.loads(path.read_text())
        except OSError as error:
            raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise CorruptError(f"{path}: is not a marker: {error}") from error

    def progress(self) -> Progress:
        """How far the scene is; costs one listing of the markers."""
        committed = self.committed_jobs()
        found = self.plans()
        complete = plans.complete_rows(found, committed)
        return Progress(sum(plan.samples for plan in found), int(np.count_nonzero(complete)))

    # ------------------------------------------------------------------------------------------------------------- base

    def has_base(self) -> bool:
        """Whether geometry and base cloud are complete."""
        return (self.folder / "base.json").exists()

    def write_base(self, geometry: Geometry, cloud: BasePointCloud) -> None:
        """Store geometry and base point cloud; the first ones written stay."""
        if self.has_base():
            return
        with store_errors("write the base", self.folder):
            built = durable.temporary(self._tmp)
            try:
                _build_base(built, {"geometry": geometry, "cloud": cloud})
                durable.place_folder(built, self.folder / "base")
            finally:
                shutil.rmtree(built, ignore_errors=True)
            files = durable.describe((p for p in (self.folder / "base").rglob("*") if p.is_file()), self.folder)
            durable.place_json({"files": files}, self.folder / "base.json", self._tmp)

    # ----------------------------------------------------------------------------------------------------------- commit

    def commit(self, job: int, outputs: JobOutputs, figures: Figures) -> bool:
        """Make a job's outputs part of the store, all or nothing; False if another worker's commit came first.

        Files that another writer left are kept where every row of the job can be read from them and ours, and are
        replaced by ours otherwise. Raises IncompleteError for outputs that are not exactly the job's or not finite,
        StoreError if the disk refuses.
        """
        rows = self.job_rows(job)
        if self.is_committed(job):
            return False
        plan = plans.plan_of(self._plans, job * self._plans[0].shard_rows)
        blocks = _blocks(self.spec, rows, outputs, plan.shard_rows)
        with store_errors(f"commit job {job}", self.folder):
            store = durable.DurableStore(plan.folder, tmp=self._tmp)
            _write_shards(store, plan, job, blocks)
            if store.kept and not self._is_readable(plan, rows):
                # of a writer that died, damaged, or split otherwise between float16 and float32; not committed yet
                if self.is_committed(job):
                    return False
                _write_shards(durable.DurableStore(plan.folder, tmp=self._tmp, replace=True), plan, job, blocks)
                self._check_readable(plan, rows)
            files = [path for name in self._arrays if (path := self._shard(plan, job, name)).exists()]
            for file in files:
                durable.sync_folder(file.parent)
            document = {"job": job, "files": durable.describe(files, self.folder), "figures": asdict(figures)}
            return durable.place_json(document, marker_path(self.folder, job), self._tmp)

    @property
    def _arrays(self) -> dict[str, schema.ArraySchema]:
        return schema.output_arrays(self.spec)

    def _shard(self, plan: StoredPlan, job: int, name: str) -> Path:
        return plan.folder / name / self._arrays[name].shard_name(job - plan.first_job)

    def _is_readable(self, plan: StoredPlan, rows: JobRows) -> bool:
        try:
            self._check_readable(plan, rows)
        except CorruptError:
            return False
        return True

    def _check_readable(self, plan: StoredPlan, rows: JobRows) -> None:
        """Read every row of a job from the files that are there; raises CorruptError if one is damaged or missing."""
        wanted = {"view": rows.new_views, "modification": rows.new_modifications}
        for name, array in self._arrays.items():
            if array.kind != "sample":
                self._check_rows(plan, rows.job, name, wanted[array.kind])
        missing = self._check_rows(plan, rows.job, "radiance", {s.row for s in rows.samples}, may_be_missing=True)
        self._check_rows(plan, rows.job, "radiance_wide", missing)

    def _check_rows(
        self, plan: StoredPlan, job: int, name: str, wanted: Set[int], *, may_be_missing: bool = False
    ) -> set[int]:
        """The rows that one shard does not hold, if that may be; raises CorruptError otherwise."""
        path, array, missing = self._shard(plan, job, name), self._arrays[name], set()
        if may_be_missing and not path.exists():
            return set(wanted)
        for row in wanted:
            if shards.read_row(path, array, plan.shard_rows, row % plan.shard_rows) is None:
                missing.add(row)
        if missing and not may_be_missing:
            raise CorruptError(f"{path}: row {min(missing)} is missing")
        return missing


def _write_shards(store: durable.DurableStore, plan: StoredPlan, job: int, blocks: Mapping[str, NDArray[Any]]) -> None:
    import zarr

    first = (job - plan.first_job) * plan.shard_rows
    for name, block in blocks.items():
        # An unused row is NaN and is left out; without one, zarr need not look for it, nor take empty photons for it.
        full = block.dtype.kind != "f" or not np.isnan(block.reshape(len(block), -1)[:, 0]).any()
        target = zarr.open_array(store, path=name, mode="r+", zarr_format=3).with_config({"write_empty_chunks": full})
        target[first : first + plan.shard_rows] = block


# ---------------------------------------------------------------------------------------- files that readers share


def read_spec(folder: Path) -> SceneSpec:
    """The spec in a scene's folder."""
    file = folder / "spec.json"
    try:
        spec = SceneSpec.model_validate_json(file.read_bytes())
    except FileNotFoundError as error:
        raise StoreError(f"{folder.parent.parent}: holds no scene {folder.name}") from error
    except OSError as error:
        raise StoreError(f"{file}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise CorruptError(f"{file}: is not a scene spec: {error}") from error
    if spec.scene_id != folder.name:
        raise CorruptError(f"{file}: has scene id {spec.scene_id}, not that of its folder")
    return spec


def load_plans(folder: Path, loaded: list[StoredPlan]) -> list[StoredPlan]:
    """The plans of a scene's folder, those already loaded taken over."""
    with store_errors("list the plans", folder):
        found = plans.numbers(folder / "plans")
    return loaded + [plans.load(folder / "plans", number) for number in found[len(loaded) :]]


def marker_path(folder: Path, job: int) -> Path:
    """Where a job's marker lies."""
    return folder / "committed" / f"{job:012d}.json"


def committed_jobs(folder: Path) -> set[int]:
    """The jobs of a scene's folder that have their marker."""
    with store_errors("list the markers", folder), contextlib.suppress(FileNotFoundError):
        return {int(path.stem) for path in (folder / "committed").iterdir() if path.suffix == ".json"}
    return set()


# ------------------------------------------------------------------------------------------------- rows of one job


def _blocks(spec: SceneSpec, rows: JobRows, outputs: JobOutputs, shard_rows: int) -> dict[str, NDArray[Any]]:
    """The job's shards by array name, (J, ...) each; arrays of which the job writes no row are left out."""
    _check_rows("radiance", {sample.row for sample in rows.samples}, outputs.radiance, rows.job)
    _check_rows("buffers", rows.new_views, outputs.buffers, rows.job)
    expected = rows.new_modifications if spec.photons.paths else frozenset()
    _check_rows("photons", expected, outputs.photons, rows.job)

    arrays = schema.output_arrays(spec)
    blocks: dict[str, NDArray[Any]] = {}
    for row, name, values in _values(spec, outputs):
        array = arrays[name]
        if values.shape != array.shape:
            raise IncompleteError(f"{name} of row {row} has shape {values.shape}; {array.shape} is required")
        if name not in blocks:
            blocks[name] = array.block(shard_rows)
        blocks[name][row % shard_rows] = _cast(values, array, row)
    return blocks


def _check_rows(what: str, expected: set[int] | frozenset[int], given: Mapping[int, object], job: int) -> None:
    if set(given) != expected:
        wrong = sorted(set(given) ^ expected)[0]
        raise IncompleteError(f"{what} of job {job}: row {wrong} is missing or not the job's")


def _values(spec: SceneSpec, outputs: JobOutputs) -> Iterator[tuple[int, str, NDArray[Any]]]:
    for row, radiance in outputs.radiance.items():
        yield row, *_radiance(radiance, spec.radiance_exponent)
    for row, buffers in outputs.buffers.items():
        for name, values in arrays_of(buffers).items():
            yield row, name, values
    for row, photons in outputs.photons.items():
        for name, values in arrays_of(photons).items():
            yield row, f"photon_{name}", values


def _radiance(radiance: F32, exponent: int) -> tuple[str, NDArray[Any]]:
    """Which array takes a sample, and what is stored there: float16 and scaled, or as it is where that cannot hold it.

    65504 is the largest float16 and 65520 the first number that rounds to infinity.
    """
    with np.errstate(over="ignore", under="ignore"):
        scaled = (radiance * np.float32(2.0**exponent)).astype(np.float16)
    return ("radiance", scaled) if np.isfinite(scaled).all() else ("radiance_wide", radiance)


def _cast(values: NDArray[Any], array: schema.ArraySchema, row: int) -> NDArray[Any]:
    with np.errstate(over="ignore", under="ignore"):
        stored = values.astype(array.dtype, copy=False)
    if stored.dtype.kind == "f" and not np.isfinite(stored).all():
        raise IncompleteError(f"{array.name} of row {row} holds a value that is not finite in {array.dtype.name}")
    return stored


def _build_base(folder: Path, records: Mapping[str, Geometry | BasePointCloud]) -> None:
    import zarr
    from zarr.storage import LocalStore

    root = zarr.open_group(LocalStore(folder), mode="w-", zarr_format=3)
    for name, record in records.items():
        group = root.create_group(name)
        for field, values in arrays_of(record).items():
            axes = (field, "component") if values.ndim == 2 else (field,)
            schema.create_input(group, field, values, axes, "see photonfarm.shared.records; scene units, at rest")
