"""A scene of a store as the trainer's source of samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from photonfarm.shared.core.records import Guides, ViewBuffers
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store.read.batch import Batch
from photonfarm.shared.store.read.reader import SceneReader
from photonfarm.trainer.data.dataset import RawSample


class StoreSource(SceneReader):
    """A `SampleSource`: the reader of a scene, with memory that samples are read into again and again."""

    def __init__(self, root: str | Path, scene_id: str, exposure: float | None = None) -> None:
        """Take the scene to follow; with an `exposure` other than the one that its spec has now, that of a run."""
        super().__init__(root, scene_id)
        self._exposure = exposure
        self._guides = False
        self._memory: Batch | None = None

    def read_spec(self) -> SceneSpec:
        """The scene's spec, with the exposure that was given."""
        spec = super().read_spec()
        return spec if self._exposure is None else spec.model_copy(update={"exposure": self._exposure})

    def read_guides(self) -> None:
        """Read guides too, from now on."""
        self._guides, self._memory = True, None

    def read_samples(self, rows: Sequence[int]) -> list[RawSample]:
        """The samples of complete rows, valid until the next call; CorruptError if bytes are not what was committed."""
        if self._memory is None or len(rows) > len(self._memory):
            self._memory = Batch.empty(self.spec, len(rows), guides=self._guides)
        read = self.read_batch(rows, self._memory)
        return [self._sample(read, place, row) for place, row in enumerate(rows)]

    def _sample(self, read: Batch, place: int, row: int) -> RawSample:
        modification, view, pass_ = self.inputs(row)
        radiance, scale = read.radiance[place], 2.0**-read.radiance_exponent
        if place in read.wide:
            radiance, scale = read.wide[place], 1.0
        buffers = ViewBuffers(**{name: values[place] for name, values in read.buffers.items()})
        known = {name: values[place] for name, values in read.guides.items()}
        guides = Guides(**known) if known else None
        return RawSample(modification, view, radiance, scale, buffers, read.visibility(place), pass_, guides)
