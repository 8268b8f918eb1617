"""A store: its format, its scenes, and how far these are."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

from photonfarm.core.errors import CorruptError, SpecError, StoreError, store_errors
from photonfarm.core.models import differing
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import SHARD_ROWS, Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.store.format import declarations
from photonfarm.store.io.storage import FORMAT_FILE, STRAY_AGE_S, TMP, Storage, open_storage, put_json
from photonfarm.store.model.plans import expand_request
from photonfarm.store.model.scene_store import (
    SCENES,
    PlanResult,
    SceneStore,
    are_there,
    is_there,
    scene_ids,
    write_spec,
)

FAILURES_FOLDER = "failures"
"""The folder in which the queue keeps why jobs failed."""

T = TypeVar("T")


class Store:
    """A sample store in a folder or bucket; holds any number of scenes."""

    def __init__(self, root: str | Path, *, create: bool = False) -> None:
        """Open a store, or make one if there is none; raises StoreError if that is impossible."""
        self.root = root
        self.storage = open_storage(root)
        self._opened: dict[str, SceneStore] = {}
        if create:
            self._create()
        self.store_id = check_format(self.storage)

    def _create(self) -> None:
        with store_errors("make a store here", where := self.storage.where):
            if self.storage.exists(FORMAT_FILE):
                return
            if Path(where).is_symlink() and not Path(where).exists():
                raise StoreError(f"{where}: is a link to what is not there; mend it, or name another store")
            foreign = set(self.storage.names("")) - {FORMAT_FILE, SCENES, TMP}
            if foreign and not self.storage.exists(FORMAT_FILE):  # no other process made one in the meantime
                raise StoreError(f"{where}: is neither empty nor a store (it holds {min(foreign)!r})")
            if are_there(self.storage):
                return  # the store has lost its document: a new one would have another id
            with self.storage.founding():
                put_json(self.storage, declarations.new_document(), FORMAT_FILE)

    def check(self) -> None:
        """Check that the store is still there; raises StoreError if it is gone, or replaced by another one."""
        store_id = check_format(self.storage)
        if store_id != self.store_id:
            raise StoreError(
                f"{self.storage.where}: was the store {self.store_id}, and now another one lies there, {store_id}"
            )

    def scene_ids(self) -> list[str]:
        """The scenes that are there, including damaged ones, in order of their ids."""
        with store_errors("list the scenes", self.storage.where):
            return scene_ids(self.storage)

    def has_scene(self, scene_id: str) -> bool:
        """Whether a scene is there, damaged or not."""
        with store_errors("look for a scene", self.storage.where):
            return is_there(self.storage, scene_id)

    def scene(self, scene_id: str) -> SceneStore:
        """One scene of the store, the same object each time; raises StoreError if it is not there."""
        if scene_id not in self._opened:
            self._opened[scene_id] = SceneStore(self.storage, scene_id)
        return self._opened[scene_id]

    def scenes(self, only: str | None = None) -> list[SceneStore]:
        """Every scene of the store, or the named one; raises StoreError if that is not there."""
        return [self.scene(scene_id) for scene_id in (self.scene_ids() if only is None else [only])]

    def each(self, what: Callable[[SceneStore], T]) -> tuple[dict[str, T], dict[str, StoreError]]:
        """The result of a function for every scene, and the errors of those that fail: damage of one affects no other.

        Raises StoreError if the store itself cannot be read.
        """
        given: dict[str, T] = {}
        failed: dict[str, StoreError] = {}
        for scene_id in self.scene_ids():
            try:
                given[scene_id] = what(self.scene(scene_id))
            except StoreError as error:
                failed[scene_id] = error
        if any(not isinstance(error, CorruptError) for error in failed.values()):
            check_format(self.storage)
        return given, failed

    def add(self, spec: SceneSpec) -> SceneStore:
        """The scene of a spec, made if it is new.

        Of a scene that is there, the spec replaces what no id covers: name, credits, exposure and strategy.
        """
        with store_errors("add a scene", self.storage.where):
            write_spec(self.storage, spec)
        self._opened.pop(spec.scene_id, None)
        return self.scene(spec.scene_id)

    def plan(
        self,
        spec: SceneSpec,
        request: Request | Chosen,
        *,
        shard_rows: int | None = None,
        usual_rows: int = SHARD_ROWS,
        halves_from: str | None = None,
        dry_run: bool = False,
    ) -> PlanResult:
        """Plan the new samples of a request; `dry_run` only counts.

        `shard_rows` is fixed by a scene's first plan; if it is None, that has `usual_rows`. `halves_from` is the id of
        another scene of the store, whose halves the jobs take over; SpecError unless its radiance is the same.
        """
        if halves_from is not None:
            self._check_same_radiance(spec, halves_from)
        if dry_run and not self.has_scene(spec.scene_id):
            expansion = expand_request(spec, request, [], first_job=0, shard_rows=shard_rows or usual_rows)
            return PlanResult(spec.scene_id, None, expansion.new, expansion.known, 0, expansion.extent)
        scene = SceneStore(self.storage, spec.scene_id, spec) if dry_run else self.add(spec)
        return scene.plan(
            request, shard_rows=shard_rows, usual_rows=usual_rows, halves_from=halves_from, dry_run=dry_run
        )

    def _check_same_radiance(self, spec: SceneSpec, scene_id: str) -> None:
        other = self.scene(scene_id).spec
        if scene_id == spec.scene_id:
            raise SpecError(f"--halves-from {scene_id}: is the scene itself, whose halves are there")
        if other.radiance_id != spec.radiance_id:
            changed = differing(other.radiance_settings(), spec.radiance_settings())
            raise SpecError(
                f"--halves-from {scene_id}: its radiance is another one, as {', '.join(changed)} differ; only scenes "
                "that differ in buffers, guides, photons and points share halves"
            )

    def sweep(self, *, stray_age_s: float = STRAY_AGE_S) -> int:
        """Remove temporary files that dead writers left; returns how many."""
        with store_errors("sweep temporary files", self.storage.where):
            return self.storage.sweep(stray_age_s=stray_age_s)


def name_of(store: Store, scene_id: str) -> str | None:
    """The name of a scene; None if its spec is unreadable: then it has to be named by its id."""
    try:
        return store.scene(scene_id).spec.name
    except StoreError:
        return None


def _put_back() -> str:
    """The remedy for a store that has lost its document."""
    return (
        f"put it back from a copy. A new store's would be {json.dumps(declarations.new_document())}: without a copy, "
        "write that, if a photonfarm of this version made the store"
    )


def check_format(storage: Storage) -> str:
    """The id of a store of this program's format and version; raises StoreError, with a sentence, for any other."""
    file = f"{storage.where}/{FORMAT_FILE}"
    try:
        document = json.loads(storage.read(FORMAT_FILE))
        name, version = document["format"], document["version"]
    except FileNotFoundError as error:
        if are_there(storage):
            raise CorruptError(f"{file}: is missing, and scenes are there: {_put_back()}") from error
        if not set(storage.names("")) - {TMP}:
            remedy = "`photonfarm submit` makes one, or name another (--store)"
            raise StoreError(f"{storage.where}: there is no store; {remedy}") from error
        raise StoreError(f"{storage.where}: is not a store: {FORMAT_FILE} is missing") from error
    except OSError as error:
        raise StoreError(f"{storage.where}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CorruptError(f"{file}: is not the document of a store: {error}; {_put_back()}") from error
    declarations.check_version(name, version, storage.where)
    if not declarations.is_store_id(store_id := document.get("id")):
        raise CorruptError(f"{file}: id = {store_id!r}: 32 lower-case hexadecimal digits are required")
    return str(store_id)


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """The planned and the committed amounts of one scene."""

    scene_id: str
    name: str
    samples_planned: int
    samples_complete: int
    jobs_planned: int
    jobs_committed: int
    size_bytes: int  # of the committed outputs
    core_s: float  # processor time of the committed jobs
    redrawn: int  # renders thrown away for a non-finite value
    markers_unreadable: int  # of committed jobs whose bytes, time and redrawn renders are not counted
    marker_error: str | None  # why the first of these cannot be read
    markers_without_plan: int = 0  # of committed jobs that no plan has: the last plan is missing
    error: str | None = None  # why the scene cannot be read; all numbers are 0 then
    counts: Mapping[str, int] = field(default_factory=dict)  # by markers: `samples`, `black` ones, `views`, `near` ones


READERS = 8
"""The number of markers read at a time: a bucket takes milliseconds for each answer."""

_BLOCK = 256
"""The number of markers that a reader takes at a time, and forgets once they are summed up."""


def scene_status(scene: SceneStore) -> SceneStatus:
    """The status of one scene; reads every marker, and holds few of them at a time.

    Unreadable markers are counted by themselves. Raises StoreError if the scene cannot be read.
    """
    done = scene.committed_jobs()
    progress, committed = scene.progress_of(done), sorted(done)
    jobs, withdrawn = scene.jobs(), scene.withdrawn_jobs()  # after the markers: each one's plan is there by now
    blocks = [committed[start : start + _BLOCK] for start in range(0, len(committed), _BLOCK)]
    with ThreadPoolExecutor(READERS) as readers:
        sums = list(readers.map(partial(_sum_markers, scene), blocks))
    errors = [error for *_, error in sums if error is not None]
    if errors and not isinstance(errors[0], CorruptError):
        check_format(scene.storage)
    return SceneStatus(
        scene.scene_id,
        scene.spec.name,
        progress.planned_samples,
        progress.committed_samples,
        jobs - len(withdrawn),
        len(committed),
        sum(size_bytes for size_bytes, *_ in sums),
        sum(core_s for _, core_s, *_ in sums),
        sum(redrawn for _, _, redrawn, *_ in sums),
        sum(unreadable for *_, unreadable, _ in sums),
        str(errors[0]) if errors else None,
        sum(job >= jobs or job in withdrawn for job in committed),
        counts=dict(sum((counts for *_, counts, _, _ in sums), Counter())),
    )


def _sum_markers(scene: SceneStore, jobs: list[int]) -> tuple[int, float, int, Counter[str], int, StoreError | None]:
    """Bytes, core seconds, redrawn renders, counts by some jobs' markers; unreadable markers, and the first error."""
    size_bytes, core_s, redrawn, errors = 0, 0.0, 0, []
    counts = Counter[str]()
    for job in jobs:
        try:
            marker = scene.marker(job)
        except StoreError as error:
            if not isinstance(error.__cause__, FileNotFoundError):  # else a repair has moved it since it was listed
                errors.append(error)
            continue
        size_bytes += sum(file["size"] for file in marker["files"].values())
        core_s += marker["figures"]["core_s"]
        redrawn += marker["figures"]["redrawn"]
        counts.update(marker["figures"].get("counts", {}))  # which jobs of older versions have not
    return size_bytes, core_s, redrawn, counts, len(errors), errors[0] if errors else None
