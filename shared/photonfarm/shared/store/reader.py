"""The store as the trainer sees it: complete samples, while more of them arrive.

Shape letters: H W image.

A sample is complete when the jobs of its own row, of its view's row and of its modification's row are committed. Rows
are read straight from the shards, every byte checked against its checksum.
"""

from __future__ import annotations

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
from photonfarm.shared.store import plans, schema, shards, writer
from photonfarm.shared.store.plans import SampleRow, StoredPlan
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


class SceneReader:
    """Follows one scene of a store. Everything but `refresh` may be called from several threads at once."""

    def __init__(self, root: str | Path, scene_id: str) -> None:
        """Name what to follow; store, scene and plans may appear later."""
        self._root = Path(root)
        self._folder = self._root / "scenes" / scene_id
        self._scene_id = scene_id
        self._spec: SceneSpec | None = None
        self._arrays: dict[str, schema.ArraySchema] = {}
        self._plans: list[StoredPlan] = []
        self._committed: set[int] = set()
        self._complete = np.zeros(0, np.bool_)

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while the scene is not there."""
        if self._spec is None:
            writer.Store(self._root)  # checks the format
            self._spec = writer.read_spec(self._folder)
            self._arrays = schema.output_arrays(self._spec)
        return self._spec

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
        if self._spec is None and not (self._folder / "spec.json").is_file():
            if (self._root / writer.FORMAT_FILE).is_file():
                writer.Store(self._root)
            return np.zeros(0, np.int64)
        _ = self.spec
        committed = writer.committed_jobs(self._folder)  # before the plans: each one's plan is there by now
        self._plans = writer.load_plans(self._folder, self._plans)
        if committed == self._committed:
            return np.zeros(0, np.int64)
        complete = plans.complete_rows(self._plans, committed)
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
        return read_base(self._folder)

    # ----------------------------------------------------------------------------------------------------------- arrays

    def _sample(self, row: int) -> SampleRow:
        if not 0 <= row < len(self._complete) or not self._complete[row]:
            raise StoreError(f"row {row} of scene {self._scene_id} is not complete")
        sample = plans.sample_at(self._plans, row)
        if sample is None:
            raise StoreError(f"row {row} of scene {self._scene_id} is not used")
        return sample

    def _radiance(self, row: int) -> F32:
        name, values = "radiance", self._row_of("radiance", row, may_be_missing=True)
        if values is None:
            name, values = "radiance_wide", self._row_of("radiance_wide", row, may_be_missing=False)
        radiance = values.astype(np.float32)
        if not np.isfinite(radiance).all():
            raise CorruptError(f"{self._shard(name, row)[0]}: {name} of row {row} is not finite")
        return radiance * np.float32(2.0 ** -self._arrays[name].attributes["radiance_exponent"])

    def _buffers(self, view_row: int) -> ViewBuffers:
        return ViewBuffers(**{f.name: self._stored(f.name, view_row) for f in fields(ViewBuffers)})

    def _stored(self, name: str, row: int) -> NDArray[Any]:
        """A row of an array, in float32 if it holds floats."""
        values = self._row_of(name, row, may_be_missing=False)
        if values.dtype.kind != "f":
            return values
        wide = values.astype(np.float32)
        if not np.isfinite(wide).all():
            raise CorruptError(f"{self._shard(name, row)[0]}: {name} of row {row} is not finite")
        return wide

    def _row_of(self, name: str, row: int, *, may_be_missing: bool) -> Any:
        path, plan = self._shard(name, row)
        if may_be_missing and not path.exists():
            return None
        values = shards.read_row(path, self._arrays[name], plan.shard_rows, row % plan.shard_rows)
        if values is None and not may_be_missing:
            raise CorruptError(f"{path}: row {row} is committed, but missing")
        return values

    def _shard(self, name: str, row: int) -> tuple[Path, StoredPlan]:
        plan = plans.plan_of(self._plans, row)
        job = row // plan.shard_rows - plan.first_job
        return plan.folder / name / self._arrays[name].shard_name(job), plan


def read_base(folder: Path) -> tuple[Geometry, BasePointCloud]:
    """Geometry and base point cloud in a scene's folder."""
    import zarr
    from zarr.storage import LocalStore

    if not (folder / "base.json").is_file():
        raise StoreError(f"{folder}: its base is not there yet; the first job of the scene writes it")
    try:
        root: Any = zarr.open_group(LocalStore(folder / "base", read_only=True), mode="r", use_consolidated=False)
        geometry = Geometry(**{f.name: np.asarray(root["geometry"][f.name][...]) for f in fields(Geometry)})
        cloud = BasePointCloud(**{f.name: np.asarray(root["cloud"][f.name][...]) for f in fields(BasePointCloud)})
    except (ValueError, KeyError, RuntimeError, FileNotFoundError) as error:
        raise CorruptError(f"{folder / 'base'}: is not what was committed: {error}") from error
    return geometry, cloud
