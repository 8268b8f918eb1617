"""A scene of a store as the trainer's source of samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import BasePointCloud, Geometry, Guides, Photons, ViewBuffers, Visibility
from photonfarm.shared.scene.modification import Modification
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import View
from photonfarm.shared.store.read.batch import Batch
from photonfarm.shared.store.read.reader import SceneReader


@dataclass(frozen=True, slots=True, eq=False)
class RawSample:
    """One sample in its stored types; its images are in memory that the next batch reuses."""

    modification: Modification
    view: View
    radiance: NDArray[np.floating]  # (2, H, W, 3), times `scale` linear
    scale: float
    buffers: ViewBuffers
    visibility: Visibility
    pass_: int
    guides: Guides | None = None  # if guides are followed


class StoreSource:
    """A `SampleSource` over `SceneReader`; scene and store may appear later."""

    def __init__(self, root: str | Path, scene_id: str) -> None:
        self._reader = SceneReader(root, scene_id)
        self._memory: Batch | None = None
        self._has_guides = False

    def ready(self) -> bool:
        """Whether spec and base are there; they come with the scene's first job."""
        return self._reader.is_begun

    def follow_guides(self) -> None:
        """Read guides too; samples are complete only with them. Raises SpecError for a scene without guides."""
        self._reader.follow_guides()
        self._memory, self._has_guides = None, True

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec; raises StoreError while it is not there."""
        return self._reader.spec

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """The geometry and the base cloud; raises StoreError while they are not there."""
        return self._reader.base()

    def refresh(self) -> NDArray[np.int64]:
        """Look for new samples; returns the rows that became complete since the last call."""
        return self._reader.refresh()

    def taken_back(self) -> NDArray[np.int64]:
        """The rows that were complete before the last `refresh` and not after it: a repair has set their jobs aside."""
        return self._reader.taken_back

    def read_batch(self, rows: Sequence[int]) -> list[RawSample]:
        """The samples of complete rows, valid until the next call; CorruptError if bytes are not what was committed."""
        if self._memory is None or len(rows) > len(self._memory):
            self._memory = Batch.empty(self.spec, len(rows), guides=self._has_guides)
        read = self._reader.read_batch(rows, self._memory)
        return [self._sample(read, place, row) for place, row in enumerate(rows)]

    def _sample(self, read: Batch, place: int, row: int) -> RawSample:
        modification, view, pass_ = self._reader.inputs(row)
        radiance, scale = read.radiance[place], 2.0**-read.radiance_exponent
        if place in read.wide:
            radiance, scale = read.wide[place], 1.0
        buffers = ViewBuffers(**{name: values[place] for name, values in read.buffers.items()})
        known = {name: values[place] for name, values in read.guides.items()}
        guides = Guides(**known) if known else None
        return RawSample(modification, view, radiance, scale, buffers, read.visibility(place), pass_, guides)

    def read_photons(self, row: int) -> Photons:
        """The photons of a complete row's configuration; raises StoreError for a scene without photons."""
        return self._reader.read_photons(row)

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration."""
        return self._reader.modification_keys(rows)

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration and view."""
        return self._reader.view_keys(rows)

    def planned(self) -> int:
        """The number of samples in all plans at the last refresh, complete or not."""
        return self._reader.planned

    def plan_requests(self) -> list[dict[str, Any]]:
        """The requests of all plans, in order, as JSON documents: all rows follow from them."""
        return list(self._reader.plan_requests)
