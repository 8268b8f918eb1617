"""A scene of a store as the trainer's source of samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.keys import Key
from photonfarm.shared.records import BasePointCloud, Geometry
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store.reader import Sample, SceneReader


class StoreSource:
    """A `SampleSource` over `SceneReader`; scene and store may appear later."""

    def __init__(self, root: str | Path, scene_id: str) -> None:
        self._reader = SceneReader(root, scene_id)

    def ready(self) -> bool:
        """Whether spec and base are there; they come with the scene's first job."""
        return self._reader.is_begun

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while it is not there."""
        return self._reader.spec

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """The geometry and the base cloud; raises StoreError while they are not there."""
        return self._reader.base()

    def refresh(self) -> NDArray[np.int64]:
        """The rows that became complete since the last call."""
        return self._reader.refresh()

    def taken_back(self) -> NDArray[np.int64]:
        """The rows that were complete before the last `refresh` and not after it: a repair has set their jobs aside."""
        return self._reader.taken_back

    def read(self, row: int) -> Sample:
        """A complete row's sample; raises CorruptError if its bytes are not what was committed."""
        return self._reader.read(row)

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration."""
        return self._reader.modification_keys(rows)

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration and view."""
        return self._reader.view_keys(rows)

    def planned(self) -> int:
        """The number of samples in all plans at the last refresh, complete or not."""
        return self._reader.planned
