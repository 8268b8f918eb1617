"""The store as the trainer sees it: complete samples, while more of them arrive.

Shape letters: H W image.

A sample is complete when the jobs of its own row, of its view's row and of its modification's row are committed. Rows
are read straight from the shards, every byte checked against its checksum.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.errors import CorruptError, StoreError
from photonfarm.shared.keys import Key, make_key
from photonfarm.shared.modification import Modification
from photonfarm.shared.records import F32, BasePointCloud, Geometry, Photons, ViewBuffers
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store import markers, plans, schema
from photonfarm.shared.store.plans import SampleRow, StoredPlan
from photonfarm.shared.store.scene_store import SCENES, read_base, read_spec
from photonfarm.shared.store.shards import Shard
from photonfarm.shared.store.storage import open_storage
from photonfarm.shared.store.store import FORMAT_FILE, check_format
from photonfarm.shared.view import View


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One complete sample, as it is trained on."""

    row: int
    modification: Modification
    view: View
    radiance: F32  # (2, H, W, 3) linear, unscaled; two independent noisy estimates A and B
    buffers: ViewBuffers
    pass_: int


OPEN_SHARDS = 256
"""Files kept open by a reader; a process may have 1024 as a rule."""


class SceneReader:
    """Follows one scene of a store. Everything but `refresh` may be called from several threads at once."""

    def __init__(self, root: str | Path, scene_id: str) -> None:
        """Name what to follow; store, scene and plans may appear later."""
        self._storage = open_storage(root)
        self._scene_id = scene_id
        self._name = f"{SCENES}/{scene_id}"
        self._spec: SceneSpec | None = None
        self._arrays: dict[str, schema.ArraySchema] = {}
        self._plans: list[StoredPlan] = []
        self._committed: set[int] = set()
        self._complete = np.zeros(0, np.bool_)
        self._shards = _OpenShards()

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while the scene is not there."""
        if self._spec is None:
            check_format(self._storage)
            self._spec = read_spec(self._storage, self._scene_id)
            self._arrays = schema.output_arrays(self._spec)
        return self._spec

    @property
    def is_begun(self) -> bool:
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
        """The rows of the samples that have become complete since the last refresh; none while nothing is there.

        Costs one listing of the markers and one of the plans. Raises StoreError for a store of another format.
        """
        if self._spec is None and not self._storage.exists(f"{self._name}/spec.json"):
            if self._storage.exists(FORMAT_FILE):
                check_format(self._storage)
            return np.zeros(0, np.int64)
        _ = self.spec
        committed = markers.jobs(self._storage, self._name)  # before the plans: each one's plan is there by now
        self._plans = plans.load_all(self._storage, self._name, self._plans)
        if committed == self._committed:
            return np.zeros(0, np.int64)
        complete = plans.complete_rows(self._plans, committed)
        if self._committed - committed:  # taken back by a repair
            self._shards.clear()
        before = np.zeros(len(complete), np.bool_)
        before[: len(self._complete)] = self._complete
        self._committed, self._complete = committed, complete
        return np.flatnonzero(complete & ~before)

    # ---------------------------------------------------------------------------------------------------------- samples

    def read(self, row: int) -> Sample:
        """One complete sample; raises CorruptError if its bytes are not what was committed."""
        sample = self._sample(row)
        return Sample(
            row,
            plans.modification_at(self._plans, sample.modification_row),
            plans.view_at(self._plans, sample.view_row),
            self._radiance(row),
            self._buffers(sample.view_row),
            sample.pass_,
        )

    def read_photons(self, row: int) -> Photons:
        """The photons of a sample's modification; raises StoreError for a scene without photons."""
        if not self.spec.photons.paths:
            raise StoreError(f"scene {self._scene_id} has photons.paths = 0; no photons are stored")
        modification_row = self.modification_row(row)
        return Photons(**{f.name: self._stored(f"photon_{f.name}", modification_row) for f in fields(Photons)})

    def modification_row(self, row: int) -> int:
        """The row of a sample's modification: equal for all samples of one configuration."""
        return self._sample(row).modification_row

    def modification_key(self, row: int) -> Key:
        """The content key of a sample's configuration, by whose hash samples are held out."""
        return plans.modification_at(self._plans, self.modification_row(row)).key(self._scene_id)

    def view_key(self, row: int) -> Key:
        """The content key of a sample's configuration and view: equal for all passes of one view."""
        view = plans.view_at(self._plans, self._sample(row).view_row)
        return make_key("view", self.modification_key(row), view.vector)

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud; raises StoreError while they are not there."""
        return read_base(self._storage, self._name)

    # ----------------------------------------------------------------------------------------------------------- arrays

    def _sample(self, row: int) -> SampleRow:
        if not 0 <= row < len(self._complete) or not self._complete[row]:
            raise StoreError(f"row {row} of scene {self._scene_id} is not complete")
        sample = plans.sample_at(self._plans, row)
        if sample is None:
            raise StoreError(f"row {row} of scene {self._scene_id} is not used")
        return sample

    def _radiance(self, row: int) -> F32:
        shard, array = self._shard("radiance", row), self._arrays["radiance"]
        if shard is None or self._within(row) not in shard:
            shard, array = self._shard("radiance_wide", row), self._arrays["radiance_wide"]
        return self._floats(shard, array, row) * np.float32(2.0 ** -array.attributes["radiance_exponent"])

    def _buffers(self, view_row: int) -> ViewBuffers:
        return ViewBuffers(**{f.name: self._stored(f.name, view_row) for f in fields(ViewBuffers)})

    def _stored(self, name: str, row: int) -> NDArray[Any]:
        """A row of an array, in float32 if it holds floats."""
        array = self._arrays[name]
        shard = self._shard(name, row)
        return self._floats(shard, array, row) if array.dtype.kind == "f" else self._row(shard, array, row)

    def _floats(self, shard: Shard | None, array: schema.ArraySchema, row: int) -> F32:
        wide = self._row(shard, array, row).astype(np.float32)
        if shard is not None and not np.isfinite(wide).all():
            raise CorruptError(f"{shard.path}: {array.name} of row {row} is not finite")
        return wide

    def _row(self, shard: Shard | None, array: schema.ArraySchema, row: int) -> NDArray[Any]:
        values = None if shard is None else shard.read(self._within(row))
        if values is None:
            raise CorruptError(
                f"{self._storage.where}/{self._file(array.name, row)}: row {row} is committed, but missing"
            )
        return values

    def _within(self, row: int) -> int:
        return row % self._plans[0].shard_rows

    def _file(self, name: str, row: int) -> str:
        plan = plans.plan_of(self._plans, row)
        return plan.shard(name, self._arrays[name], row // plan.shard_rows)

    def _shard(self, name: str, row: int) -> Shard | None:
        """The shard of a row; None if there is none, which may be of `radiance` and `radiance_wide` alone."""
        file, array = self._file(name, row), self._arrays[name]
        shard = self._shards.get(file)
        if shard is None:
            if array.kind == "sample" and not self._storage.exists(file):
                return None
            shard = Shard(self._storage.local(file), array, self._plans[0].shard_rows)
            self._shards.put(file, shard)
        return shard


class _OpenShards:
    """The shards used last; one that is dropped is closed once nobody reads it any more."""

    def __init__(self) -> None:
        self._shards: OrderedDict[str, Shard] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, file: str) -> Shard | None:
        with self._lock:
            if file in self._shards:
                self._shards.move_to_end(file)
            return self._shards.get(file)

    def put(self, file: str, shard: Shard) -> None:
        with self._lock:
            self._shards[file] = shard
            while len(self._shards) > OPEN_SHARDS:
                self._shards.popitem(last=False)

    def clear(self) -> None:
        with self._lock:
            self._shards.clear()
