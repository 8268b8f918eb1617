"""A scene's samples as they are read: those that are complete, while more of them arrive.

Shape letters: B batch, R rows of the scene, H W image.

A sample is complete when the jobs of its own row, of its view's row and of its modification's row are committed. Rows
are read straight from the shards, every byte checked against its checksum.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, IncompleteError, StoreError, store_errors
from photonfarm.core.keys import KEY_BYTES, Key
from photonfarm.core.records import F32, BasePointCloud, Geometry, Photons
from photonfarm.plan.request import PlannedContent
from photonfarm.scene.modification import Modification, modification_keys
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, view_keys
from photonfarm.store.format import markers, schema, shards
from photonfarm.store.format.markers import FollowedMarkers
from photonfarm.store.format.shards import Shard
from photonfarm.store.io.storage import FORMAT_FILE, look_into, open_storage
from photonfarm.store.model import plans
from photonfarm.store.model.lease import announce_work, read_leases
from photonfarm.store.model.plans import StoredPlan
from photonfarm.store.model.scene_store import SCENES, is_there, read_base, read_spec
from photonfarm.store.model.store import check_format
from photonfarm.store.read.batch import Batch, Sample

REPAIR = "`photonfarm store check --repair` sets its job aside, and workers render it again"
"""The remedy for damaged samples."""

REMEMBERED_S = 0.2  # for which a look counts that finds the scene not forgotten: too short to render it anew


class SceneReader:
    """Follows one scene of a store. Everything but `refresh` may be called from several threads at once."""

    def __init__(self, root: str | Path, scene_id: str, *, exposure: float | None = None) -> None:
        """Take the scene to follow; store, scene and plans may appear later.

        With an `exposure`, the spec has that one, as a training run keeps the one that it began with.
        """
        self._storage, self._name = open_storage(root), f"{SCENES}/{scene_id}"
        self._scene_id, self._exposure = scene_id, exposure
        self._spec: SceneSpec | None = None
        self._arrays: dict[str, schema.ArraySchema] = {}
        self._markers = FollowedMarkers(self._storage, self._name)
        self._plans: list[StoredPlan] = []
        self.plan_requests: list[dict[str, Any]] = []  # the requests of the plans, from which all rows follow
        self._committed: set[int] = set()
        self._complete = np.zeros(0, np.bool_)
        self._inputs, self._key = PlannedContent(), np.zeros((0, KEY_BYTES), np.uint8)
        self._view_row = self._modification_row = self._pass = np.zeros(0, np.int64)  # (R,) of each sample
        self._shards: dict[tuple[str, int], Shard] = {}  # open ones, by array and job
        self._lock = threading.Lock()
        self._remembered_s = -REMEMBERED_S  # when it was last seen that the scene is not forgotten
        self._base: tuple[Geometry, BasePointCloud] | None = None

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while the scene is not there."""
        if self._spec is None:
            check_format(self._storage)
            self._spec = self.read_spec()
            self._arrays = schema.output_arrays(self._spec)
        return self._spec

    def read_spec(self) -> SceneSpec:
        """The scene's spec as it is stored now; what a reader began with stays its `spec`."""
        spec = read_spec(self._storage, self._scene_id)
        return spec if self._exposure is None else spec.model_copy(update={"exposure": self._exposure})

    def ready(self) -> bool:
        """Whether spec and base are there; the base comes with the scene's first job."""
        return all(self._storage.exists(f"{self._name}/{name}") for name in ("spec.json", "base/zarr.json"))

    @property
    def rows(self) -> NDArray[np.int64]:
        """The rows of all samples that were complete at the last refresh, ascending."""
        return np.flatnonzero(self._complete)

    @property
    def planned(self) -> int:
        """The number of samples in all plans at the last refresh, complete or not."""
        return sum(plan.samples for plan in self._plans)

    def refresh(self) -> NDArray[np.int64]:
        """Look for new samples; returns the rows of those completed since the last refresh, none without a scene.

        Costs a listing of the plans, and what `FollowedMarkers` costs. StoreError for a store of another format.
        """
        if self._spec is None and not self._storage.exists(f"{self._name}/spec.json"):
            if not self._storage.exists(FORMAT_FILE):
                return np.zeros(0, np.int64)
            check_format(self._storage)
            if not is_there(self._storage, self._scene_id):
                return np.zeros(0, np.int64)
        _ = self.spec
        committed = self._markers.look()  # before the plans: each one's plan is there by now
        self._load_plans()
        if committed == self._committed:
            return np.zeros(0, np.int64)
        complete = plans.complete_rows(self._plans, committed)
        if self._committed - committed:  # markers removed by a repair
            with self._lock:
                self._shards.clear()
        before = np.zeros(len(complete), np.bool_)
        before[: len(self._complete)] = self._complete
        self._committed, self._complete = committed, complete
        return np.flatnonzero(complete & ~before)

    def _load_plans(self) -> None:
        known, loaded = self._plans, plans.load_all(self._storage, self._name, self._plans)
        if known and (not loaded or loaded[0].forgotten != known[0].forgotten):
            raise self._forgotten()
        self._plans = loaded
        if self._plans != known:
            self._committed = set()  # complete rows are to be counted again
            inputs = plans.content(self._plans)
            self._view_row, self._modification_row = inputs.column("sample_view"), inputs.column("sample_modification")
            self._pass, self._key, self._inputs = inputs.column("sample_pass"), inputs.column("sample_key"), inputs
            self.plan_requests = [
                {"first_row": plan.first_row, "samples": plan.named, "request": plan.request.model_dump(mode="json")}
                for plan in self._plans
            ]

    def _check_not_forgotten(self) -> None:
        """Raise IncompleteError if the scene was forgotten: other plans may have the names of the files opened here."""
        if time.monotonic() - self._remembered_s < REMEMBERED_S:
            return
        names = self._storage.names(f"{self._name}/{plans.PLANS}")
        if sum(name.startswith(plans.FORGOTTEN) for name in names) != self._plans[0].forgotten:
            raise self._forgotten()
        self._remembered_s = time.monotonic()

    def _forgotten(self) -> IncompleteError:
        name = f"{self._storage.where}: scene {self._scene_id}"
        return IncompleteError(f"{name} was forgotten; if it was submitted again, open it again, or train a new --run")

    # ---------------------------------------------------------------------------------------------------------- samples

    def read_batch(self, rows: Sequence[int] | NDArray[np.int64], out: Batch | None = None) -> Batch:
        """Read complete samples in the order of `rows`, in their stored types; every byte is checked.

        They are read into the first places of `out`, which are returned, with all that it has memory for; without it,
        into new memory, without guides. Raises CorruptError if bytes are not what was committed; the content of `out`
        is then undefined.
        """
        chosen = np.asarray(rows, np.int64)
        self._check_complete(chosen)
        if out is None:
            out = Batch.empty(self.spec, len(chosen))
        if len(chosen) > len(out):
            raise ValueError(f"rows: {len(chosen)} samples do not fit a batch of {len(out)}")
        batch = out.first(len(chosen))
        batch.rows[:], batch.view_rows[:] = chosen, self._view_row[chosen]
        batch.modification_rows[:] = self._modification_row[chosen]
        batch.wide.clear()
        with self._reading(chosen, "read samples"):
            for place, row in enumerate(chosen.tolist()):
                self._read_radiance(row, place, batch)
            for name, memory in batch.of_view.items():
                for place, row in enumerate(batch.view_rows.tolist()):
                    self._read_into(name, row, memory[place])
        return batch

    def read_samples(self, rows: Sequence[int], out: Batch | None = None) -> list[Sample]:
        """Read complete samples as `read_batch` does, and give them one by one, in the memory of that batch."""
        batch = self.read_batch(rows, out)
        return [self._sample(row, place, batch) for place, row in enumerate(rows)]

    def _sample(self, row: int, place: int, batch: Batch) -> Sample:
        (key,), (modification, view, pass_number) = self.sample_keys([row]), self.inputs(row)
        radiance, scale = (batch.wide[place], 1.0) if place in batch.wide else (batch.radiance[place], batch.scale)
        of_view = batch.buffers(place), batch.visibility(place), batch.guides(place)
        shared = (lambda: self.base()[1]), partial(self.read_photons, row)
        return Sample(row, key, modification, view, pass_number, radiance, *of_view, scale, *shared)

    def read(self, row: int, *, guides: bool = False) -> Sample:
        """Read one complete sample in float32, with its view's `guides` or without.

        Raises CorruptError if its bytes are not what was committed, IncompleteError if it is no longer there.
        """
        (stored,) = self.read_samples([row], Batch.empty(self.spec, 1, guides=guides))
        sample = stored.decoded()
        if not all(np.isfinite(values).all() for values in (sample.radiance, *sample.images.values())):
            where = f"{self._storage.where}/{self._name}"
            raise CorruptError(f"{where}: row {row} holds a value that is not finite; {REPAIR}")
        return sample

    def read_radiance(self, row: int) -> F32:
        """Read the halves of one complete sample, and nothing else, (2, H, W, 3) linear, unscaled."""
        return self.read_batch([row], Batch.empty(self.spec, 1, buffers=False)).linear(0)

    def sample_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content keys of many samples."""
        return [self._key[row].tobytes() for row in rows]

    def rows_by_key(self) -> dict[Key, int]:
        """The rows of all complete samples by their content keys."""
        rows = self.rows.tolist()
        return dict(zip(self.sample_keys(rows), rows, strict=True))

    def inputs(self, row: int) -> tuple[Modification, View, int]:
        """The configuration, the view and the number of the noisy pass of a complete sample."""
        modification = plans.modification_at(self._plans, self.modification_row(row))
        return modification, plans.view_at(self._plans, int(self._view_row[row])), int(self._pass[row])

    def read_photons(self, row: int) -> Photons:
        """Read the photons of a sample's modification; raises StoreError for a scene without photons."""
        if not self.spec.photons.paths:
            raise StoreError(f"scene {self._scene_id} has photons.paths = 0; no photons are stored")
        modification_row = self.modification_row(row)
        with self._reading([row], "read photons"):
            bounce = self._read("photon_bounce", modification_row)
            names = [f.name for f in fields(Photons) if f.name != "bounce"]
            read = {name: np.asarray(self._read(f"photon_{name}", modification_row), np.float32) for name in names}
        return Photons(**read, bounce=bounce)

    def rows_of_view(self, view_row: int) -> NDArray[np.int64]:
        """The rows of the complete samples of the view in a row, ascending: its passes."""
        rows = np.flatnonzero(self._view_row == view_row)
        rows = rows[rows < len(self._complete)]  # a plan may be younger than the last marker
        return rows[self._complete[rows]]

    def earlier_passes(self, row: int) -> NDArray[np.int64]:
        """The rows of a complete sample's view before it in the same job, ascending: they are complete if it is."""
        first = row - row % self._plans[0].shard_rows
        return first + np.flatnonzero(self._view_row[first:row] == self.view_row(row))

    def view_row(self, row: int) -> int:
        """The row of a sample's view: equal for all its passes."""
        self._check_complete(np.array([row]))
        return int(self._view_row[row])

    def modification_row(self, row: int) -> int:
        """The row of a sample's modification: equal for all samples of one configuration."""
        self._check_complete(np.array([row]))
        return int(self._modification_row[row])

    def modification_key(self, row: int) -> Key:
        """The content key of a sample's configuration, by whose hash samples are held out."""
        return self.modification_keys([row])[0]

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content keys of the configurations of many samples, each hashed once."""
        chosen = np.asarray(rows, np.int64)
        self._check_complete(chosen)
        if not len(chosen):
            return []
        distinct, place = np.unique(self._modification_row[chosen], return_inverse=True)
        keys = modification_keys(self.spec.radiance_id, self._inputs.vectors("modification", distinct))
        return [keys[i] for i in place.tolist()]

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content keys of the configurations and views of many samples, each hashed once."""
        of_row = self.modification_keys(rows)
        if not of_row:
            return []
        distinct, first, place = np.unique(self._view_row[np.asarray(rows)], return_index=True, return_inverse=True)
        vectors = self._inputs.vectors("view", distinct)
        keys = view_keys([of_row[i] for i in first.tolist()], vectors)
        return [keys[i] for i in place.tolist()]

    def are_uniform(self, rows: Sequence[int]) -> list[bool]:
        """Whether configurations and views of many samples were drawn uniformly from the spec: both densities are 1."""
        return self._inputs.are_uniform(self._modification_row[list(rows)], self._view_row[list(rows)])

    def view_key(self, row: int) -> Key:
        """The content key of a sample's configuration and view: equal for all passes of one view."""
        return self.view_keys([row])[0]

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud, read once; raises StoreError while they are not there."""
        if self._base is None:
            geometry, cloud = read_base(self._storage, self._name)
            self._base = geometry, replace(cloud, pivots=self.spec.pivots)
        return self._base

    # ----------------------------------------------------------------------------------------------------------- others

    def at_work(self, what: str) -> AbstractContextManager[None]:
        """Announce that this process is at work in the scene, as `lease.announce_work` does."""
        return announce_work(self._storage, self._scene_id, what)

    def lease(self) -> str | None:
        """Who has the scene for itself now, in words; None if nobody has. Costs a listing."""
        return read_leases(self._storage).get(self._scene_id)

    def doubt(self) -> None:
        """Look for all markers at the next refresh: some may have been removed."""
        self._markers.doubt()

    # ----------------------------------------------------------------------------------------------------------- arrays

    def _check_complete(self, rows: NDArray[np.int64]) -> None:
        there = (rows >= 0) & (rows < len(self._complete))
        there[there] = self._complete[rows[there]]
        if not there.all():
            raise self._incomplete(int(rows[~there][0]))

    def _incomplete(self, row: int) -> IncompleteError:
        return IncompleteError(f"row {row} of scene {self._scene_id} is not complete; workers render it")

    def _read_radiance(self, row: int, place: int, batch: Batch) -> None:
        shard, within = self._shard("radiance", row)
        if shard is not None and within in shard:
            self._read_from(shard, "radiance", row, batch.radiance[place])
            return
        wide, _ = self._shard("radiance_wide", row)
        if wide is None or within not in wide:
            raise self._missing("radiance" if shard is None or wide is not None else "radiance_wide", row)
        batch.radiance[place] = np.nan  # so that a caller that ignores `wide` notices
        batch.wide[place] = self._read("radiance_wide", row)

    def _read(self, name: str, row: int) -> NDArray[Any]:
        array = self._arrays[name]
        values = np.empty(array.shape, array.dtype)
        self._read_into(name, row, values)
        return values

    def _read_into(self, name: str, row: int, values: NDArray[Any]) -> None:
        shard, within = self._shard(name, row)
        if shard is None or within not in shard:
            raise self._missing(name, row)
        self._read_from(shard, name, row, values)

    def _missing(self, name: str, row: int) -> CorruptError:
        """The error of a row that is not in its shard; raises StoreError if the store is gone."""
        file = self._file(name, row // self._plans[0].shard_rows)
        self._storage.require()
        return CorruptError(f"{self._storage.where}/{file}: row {row} is committed, but missing")

    @contextmanager
    def _reading(self, rows: Sequence[int] | NDArray[np.int64], what: str) -> Iterator[None]:
        """Turn errors of the disk into StoreErrors; of damage, tell the remedy; IncompleteError for rows now gone."""
        with store_errors(what, self._storage.where):
            try:
                yield
            except CorruptError as error:
                self._markers.doubt()
                self._remembered_s = -REMEMBERED_S
                self._check_not_forgotten()
                for row in rows:
                    for part in (row, self._view_row[row], self._modification_row[row]):
                        marker = markers.marker_name(self._name, int(part) // self._plans[0].shard_rows)
                        if not self._storage.exists(marker):
                            raise self._incomplete(int(row)) from error
                raise CorruptError(f"{error}; {REPAIR}") from error

    def _read_from(self, shard: Shard, name: str, row: int, values: NDArray[Any]) -> None:
        """Read a row of an open shard; if that fails, of the present file, which may have been repaired since.

        In a bucket, a new copy is fetched: this machine's may be damaged.
        """
        job, within = divmod(row, self._plans[0].shard_rows)
        try:
            shard.read_into(within, values)
        except CorruptError:
            self._storage.renew(self._file(name, job))
            again, _ = self._shard(name, row, anew=True)
            if again is None or within not in again:
                raise
            again.read_into(within, values)

    def _file(self, name: str, job: int) -> str:
        plan = plans.plan_of(self._plans, job * self._plans[0].shard_rows)
        return plan.shard(name, self._arrays[name], job)

    def _shard(self, name: str, row: int, *, anew: bool = False) -> tuple[Shard | None, int]:
        """The shard of a row, and its place in it; None if there is no shard, which is possible for radiance alone."""
        job, within = divmod(row, self._plans[0].shard_rows)
        shard = None if anew else self._shards.get((name, job))
        if shard is None:
            file, array, rows = self._file(name, job), self._arrays[name], self._plans[0].shard_rows
            if array.kind == "sample" and not self._storage.exists(file):
                return None, within
            try:
                shard = look_into(self._storage, file, lambda path: Shard(path, array, rows))
            except CorruptError:
                self._storage.require()
                raise
            self._check_not_forgotten()
            with self._lock:
                self._shards[name, job] = shard
                if len(self._shards) > shards.OPEN_SHARDS:  # it is closed once its last reader is done
                    del self._shards[next(iter(self._shards))]
        return shard, within
