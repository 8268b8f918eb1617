"""A scene of a store as the trainer's source of samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.keys import Key, make_key
from photonfarm.shared.records import BasePointCloud, Geometry
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store.plans import StoredPlan, sample_at, view_at
from photonfarm.shared.store.reader import Sample, SceneReader
from photonfarm.shared.store.writer import load_plans


class StoreSource:
    """A `SampleSource` over `SceneReader`; scene and store may appear later."""

    def __init__(self, root: Path, scene_id: str) -> None:
        self._reader = SceneReader(root, scene_id)
        self._folder = root / "scenes" / scene_id
        self._plans: list[StoredPlan] = []

    def ready(self) -> bool:
        """Whether spec and base are there; they come with the scene's first job."""
        return (self._folder / "spec.json").is_file() and (self._folder / "base.json").is_file()

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while it is not there."""
        return self._reader.spec

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """The geometry and the base cloud; raises StoreError while they are not there."""
        return self._reader.base()

    def refresh(self) -> NDArray[np.int64]:
        """The rows that became complete since the last call."""
        rows = self._reader.refresh()
        self._plans = load_plans(self._folder, self._plans)
        return rows

    def read(self, row: int) -> Sample:
        """A complete row's sample; raises CorruptError if its bytes are not what was committed."""
        return self._reader.read(row)

    def modification_key(self, row: int) -> Key:
        """The content key of a row's configuration."""
        return self._reader.modification_key(row)

    def view_key(self, row: int) -> Key:
        """The content key of a row's configuration and view."""
        sample = sample_at(self._plans, row)
        if sample is None:
            raise KeyError(f"row {row} is not used")
        return make_key("view", self.modification_key(row), view_at(self._plans, sample.view_row).vector)

    def planned(self) -> int:
        """The number of samples in all plans at the last refresh, complete or not."""
        return sum(plan.samples for plan in self._plans)
