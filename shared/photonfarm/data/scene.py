"""A scene of a store, ready to be read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.formatting import format_count
from photonfarm.core.records import Geometry
from photonfarm.plan.hold_out import HOLD_OUT, sides_of
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store
from photonfarm.store.read.batch import Batch, Sample
from photonfarm.store.read.find import scene_named

if TYPE_CHECKING:
    from photonfarm.data.torch_dataset import SceneDataset

Split = Literal["train", "held-out", "all"]


def open_scene(store: str | Path, scene: str, *, guides: bool = True) -> Scene:
    """A scene of a store, with the samples that are complete now.

    `store` is a folder, or the URL of a bucket (`s3://bucket/prefix`). `scene` is a scene's name, its id, or the
    beginning of its id. With `guides` each sample carries the guides of its view; without them less is read.

    Raises StoreError if there is no such store, or no such scene in it (the message names the scenes that exist).
    """
    opened = Store(store)
    stored = opened.scene(scene_named(opened, scene))
    return Scene(store, stored.scene_id, guides=guides)


class Scene:
    """The complete samples of one scene, in the order of their rows; `refresh` adds those completed since.

    A pickled scene holds only its place in the store and its rows, so that spawned processes read the same samples.
    """

    def __init__(
        self, store: str | Path, scene_id: str, *, guides: bool = True, rows: Sequence[int] | None = None
    ) -> None:
        """Use `open_scene`. With `rows` the scene consists of these samples alone, and does not change."""
        self._store, self._id, self._guides = store, scene_id, guides
        self._reader = SceneReader(store, scene_id)
        self._reader.refresh()
        self._frozen = rows is not None
        self._rows = self._reader.rows if rows is None else np.asarray(rows, np.int64)

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (self._store, self._id, self._guides, self._rows.tolist() if self._frozen else None)

    def __repr__(self) -> str:
        samples = format_count(len(self), "sample")
        return f"<scene {self.name} ({self.id}), {samples}{', a snapshot' if self._frozen else ''}>"

    # ---------------------------------------------------------------------------------------------------- what it is

    @property
    def id(self) -> str:
        """The scene's id, 32 hexadecimal digits: a hash of the spec."""
        return self._id

    @property
    def name(self) -> str:
        """The scene's name, as the spec has it."""
        return self.spec.name

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec: its film, light transport, movable objects and lights."""
        return self._reader.spec

    @property
    def has_guides(self) -> bool:
        """Whether samples carry the guides of their views."""
        return self._guides

    @property
    def geometry(self) -> Geometry:
        """The scene's triangles at rest; StoreError while no job has been committed."""
        return self._reader.base()[0]

    @property
    def rows(self) -> NDArray[np.int64]:
        """The row in the store of each sample, (N,), ascending."""
        return self._rows

    # ------------------------------------------------------------------------------------------------------- samples

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        """The sample at a place, from 0, or from −1 backwards; a list of samples for a slice.

        Raises IndexError beyond the last sample, and CorruptError if stored bytes are not what was committed.
        """
        if isinstance(index, slice):
            return [self._sample(int(row)) for row in self._rows[index]]
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of scene {self.name}: it has {len(self)} complete samples")
        return self._sample(int(self._rows[index]))

    def __iter__(self) -> Iterator[Sample]:
        return (self._sample(int(row)) for row in self._rows)

    __contains__ = None  # samples are not compared, and looking would read all of them; ask `row in scene.rows`

    def row(self, number: int) -> Sample:
        """The sample in a row of the store, by the number that `photonfarm store find` and other verbs print.

        Raises LookupError if this scene or split has no complete sample there, and CorruptError as indexing does.
        """
        if number not in self._rows:
            there = f", in rows {self._rows[0]} to {self._rows[-1]}" if len(self) else ""
            raise LookupError(f"row {number} of scene {self.name}: is none of its {len(self)} complete samples{there}")
        return self._sample(int(number))

    def _sample(self, row: int) -> Sample:
        return self._reader.read(row, guides=self._guides)

    def read_samples(self, rows: Sequence[int], out: Batch) -> list[Sample]:
        """Samples by their rows, as they are stored, in the memory of a batch; see `SceneReader.read_samples`."""
        return self._reader.read_samples(rows, out)

    # ------------------------------------------------------------------------------------------------ while it grows

    def refresh(self) -> int:
        """Add the samples completed since the last call; returns how many more there are, below 0 after a repair.

        Raises ValueError for a snapshot, which does not change.
        """
        if self._frozen:
            raise ValueError(f"{self!r} does not change; refresh the scene that it was taken of")
        before = len(self._rows)
        self._reader.refresh()
        self._rows = self._reader.rows
        return len(self._rows) - before

    def snapshot(self) -> Scene:
        """The samples that are complete now, as a scene that does not change."""
        return self._of(self._rows)

    def split(self, split: Split, *, hold_out: float = HOLD_OUT) -> Scene:
        """A snapshot of the samples to train on, of those that are held out, or of all.

        A share `hold_out` of the configurations (in a static scene, of the views) is held out whole, chosen by a hash
        of their content: exactly those that `photonfarm train --hold-out` of the same share holds out. Raises
        ValueError for another split, and for a share that is not between 0 and 1.
        """
        if not 0 < hold_out < 1:
            raise ValueError(f"hold_out = {hold_out!r}: must lie between 0 and 1")
        if split not in (splits := ("train", "held-out", "all")):
            raise ValueError(f"split = {split!r}: is none of {', '.join(splits)}")
        if split == "all":
            return self.snapshot()
        sides = sides_of(self._reader, self._rows.tolist(), hold_out)
        return self._of(self._rows[np.array([side == split for side in sides], np.bool_)])

    def torch(
        self,
        split: Split = "all",
        *,
        hold_out: float = HOLD_OUT,
        fields: Sequence[str] | None = None,
        exposure: float = 1.0,
        points: int | None = None,
    ) -> SceneDataset:
        """The samples of a split as a torch dataset of dictionaries; it pickles, so any DataLoader works.

        Without a split it has all samples of this scene, those to be held out among them: to train, name "train", or
        take the dataset of a scene that is split already. `fields` are the names of tensors, by default all images,
        `modification` and `view`; `SceneDataset` has all. Light is multiplied by `exposure`, such as the one of the
        spec; of the scene's points the first `points` are given. Raises ValueError as `split` does, SpecError for
        another field, and ImportError without torch.
        """
        from photonfarm.data.torch_dataset import SceneDataset

        return SceneDataset(self.split(split, hold_out=hold_out), fields, exposure=exposure, points=points)

    def _of(self, rows: NDArray[np.int64]) -> Self:
        return type(self)(self._store, self._id, guides=self._guides, rows=rows.tolist())


def _reopen(store: str | Path, scene_id: str, guides: bool, rows: Sequence[int] | None) -> Scene:
    """The scene that a pickled scene is restored to."""
    return Scene(store, scene_id, guides=guides, rows=rows)
