"""The trainer's samples: read from a store that grows, split by configuration, as arrays ready for a batch.

Shape letters: B batch, P points, H W image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.keys import Key, Stream
from photonfarm.shared.core.records import (
    F32,
    BasePointCloud,
    Geometry,
    Guides,
    Photons,
    ViewBuffers,
    Visibility,
    arrays_of,
)
from photonfarm.shared.plan.hold_out import Keyed, units_of
from photonfarm.shared.plan.request import sample_key
from photonfarm.shared.scene.modification import Modification
from photonfarm.shared.scene.pointcloud import rebuild
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View
from photonfarm.trainer.networks.inputs import (
    POINTS_ONLY,
    GuideInputs,
    Inputs,
    Needs,
    NoisyColour,
    PhotonInputs,
    PointInputs,
    given,
    map_tensors,
)


@dataclass(frozen=True, slots=True, eq=False)
class RawSample:
    """One sample in its stored types; its images are in memory that the next read reuses."""

    modification: Modification
    view: View
    radiance: NDArray[np.floating]  # (2, H, W, 3) half-estimates A and B, times `scale` linear
    scale: float  # a power of two
    buffers: ViewBuffers
    visibility: Visibility
    pass_: int  # the number of the noisy pass of this view
    guides: Guides | None = None  # if they are read


class SampleSource(Keyed[Sequence[int]], Protocol):
    """The samples of one scene: the store's reader, or anything that behaves like it. Used by one thread at a time."""

    def ready(self) -> bool:
        """Whether spec and base are there; they come with the scene's first job."""

    def read_guides(self) -> None:
        """Read guides too, from now on."""

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """The geometry and the base cloud."""

    def refresh(self) -> NDArray[np.int64]:
        """Look for new samples; returns the rows that became complete since the last call."""

    @property
    def taken_back(self) -> NDArray[np.int64]:
        """The rows that were complete before the last `refresh` and not after it; workers render them again."""

    def read_samples(self, rows: Sequence[int]) -> Sequence[RawSample]:
        """The samples of complete rows, valid until the next call; StoreError if one is incomplete or unreadable."""

    def read_photons(self, row: int) -> Photons:
        """The photons of a complete row's configuration; raises StoreError if the scene has none."""

    @property
    def planned(self) -> int:
        """The number of samples in all plans so far, complete or not."""

    @property
    def plan_requests(self) -> list[dict[str, Any]]:
        """The requests of all plans so far, in order, as JSON documents: all rows follow from them."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingBatch:
    """Samples as tensors; valid until the next batch is taken. Incomplete samples are left out, possibly all."""

    rows: tuple[int, ...]
    units: tuple[Key, ...]  # by which each is held out: equal for samples that are not independent
    inputs: Inputs
    target: Tensor  # (B, 2, H, W, 3) half-estimates A and B, linear radiance × exposure

    @classmethod
    def empty(
        cls, size: int, points: int, spec: SceneSpec, needs: Needs = POINTS_ONLY, *, pinned: bool = False
    ) -> TrainingBatch:
        """Memory for the needed parts of `size` samples, which is reused for every batch."""

        def memory(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            try:
                return torch.empty(size, *shape, dtype=dtype, pin_memory=pinned)
            except RuntimeError as error:  # torch's error for want of memory
                raise SpecError(f"batch = {size}: no memory for so many samples") from error

        target = memory(2, spec.film.height, spec.film.width, 3)
        return cls((), (), Inputs.empty(memory, points, spec, needs), target)

    def filled(self, rows: tuple[int, ...], units: tuple[Key, ...]) -> TrainingBatch:
        """The first samples of this memory, with their rows and the units by which they are held out."""
        n = len(rows)
        return TrainingBatch(rows, units, map_tensors(lambda tensor: tensor[:n], self.inputs), self.target[:n])

    def to(self, device: torch.device) -> TrainingBatch:
        """The same batch on a device; itself on the CPU."""
        inputs = map_tensors(lambda tensor: tensor.to(device), self.inputs)
        return TrainingBatch(self.rows, self.units, inputs, self.target.to(device))

    def for_training(self) -> TrainingBatch:
        """The batch with targets that no input depends on: itself, unless its inputs hold noisy colour.

        Otherwise it is twice as long: the samples with A in the inputs and B as the target, (B, 1, H, W, 3), then the
        same samples with both exchanged (Lehtinen et al., Noise2Noise, 2018). The same pixels are kept of both.
        """
        noisy = self.inputs.noisy
        if noisy is None:
            return self
        half_b = NoisyColour(self.target[:, 1] * noisy.kept[..., None], noisy.kept)
        inputs = map_tensors(lambda *both: torch.cat(both), self.inputs, replace(self.inputs, noisy=half_b))
        target = torch.cat([self.target[:, 1:], self.target[:, :1]])
        return TrainingBatch(2 * self.rows, 2 * self.units, inputs, target)


def kept_count(spec: SceneSpec, of: int) -> int:
    """The number of pixels that one of `of` makes; SpecError if the film has fewer than `of` pixels."""
    pixels = spec.film.height * spec.film.width
    if of > pixels:
        raise SpecError(
            f"one of {of} pixels is to be kept, and the film has {pixels} ({spec.film.width}×{spec.film.height}); "
            "keep one of fewer"
        )
    return pixels // of


def kept_pixels(sample: RawSample, spec: SceneSpec, of: int) -> NDArray[np.bool_]:
    """One of `of` pixels, (H, W), H·W / `of` in all: a random choice derived from the sample's content key.

    So each pass of a view keeps pixels of its own, and a resumed run gets the same pixels. A smaller share of the
    pixels is a subset of a larger one. Raises SpecError as `kept_count` does.
    """
    film = spec.film.height, spec.film.width
    key = sample_key(spec.radiance_id, sample.modification, sample.view.vector, sample.pass_)
    chance = Stream(key, "kept pixels").uniform(*film)
    last = kept_count(spec, of) - 1
    kept: NDArray[np.bool_] = chance <= np.partition(chance, last, axis=None)[last]
    return kept


def read_into(
    memory: TrainingBatch, source: SampleSource, rows: Sequence[int], needs: Needs, cloud: BasePointCloud
) -> TrainingBatch:
    """Read complete rows of a source into the first places of a batch's memory; StoreError if one cannot be read."""
    spec = source.spec
    for place, (row, sample) in enumerate(zip(rows, source.read_samples(rows), strict=True)):
        fill(memory, place, sample, spec, cloud)
        if memory.inputs.photons is not None:
            fill_photons(memory.inputs.photons, place, source.read_photons(row))
        if needs.kept:
            _fill_noisy(memory, place, kept_pixels(sample, spec, needs.kept))
    return memory.filled(tuple(rows), tuple(units_of(source, rows)))


def fill(batch: TrainingBatch, place: int, sample: RawSample, spec: SceneSpec, cloud: BasePointCloud) -> None:
    """Write one sample into a batch's memory, except its photons and its noisy colour.

    That is its camera, its buffers, its exposed targets; if needed, its points; and which points and photons the view
    sees. Stored types become float32 on the way, in one pass over the images.
    """
    i, b = batch.inputs, sample.buffers
    i.world_to_camera[place] = torch.from_numpy(Camera.of(sample.view, spec).world_to_camera)
    for memory, array in ((i.depth, b.depth), (i.albedo, b.albedo), (i.normal, b.normal)):
        memory[place] = torch.from_numpy(array)
    if i.guides is not None:
        _fill_guides(i.guides, place, sample.guides, spec.exposure)
    batch.target[place] = torch.from_numpy(sample.radiance)
    batch.target[place].mul_(spec.exposure * sample.scale)
    if i.points is not None:
        _fill_points(i.points, place, *rebuild(cloud, sample.modification), sample.visibility.points)
    if i.photons is not None:
        i.photons.seen[place] = torch.from_numpy(sample.visibility.photons)


OF_LIGHT = ("emission", "direct", "gloss", "point_light")
"""The guides in units of radiance, or of irradiance, which are therefore exposed."""


def _fill_guides(memory: GuideInputs, place: int, guides: Guides | None, exposure: float) -> None:
    for name, array in arrays_of(given(guides)).items():
        values = getattr(memory, name)
        values[place] = torch.from_numpy(array)
        if name in OF_LIGHT:
            values[place].mul_(exposure)


def fill_photons(memory: PhotonInputs, place: int, photons: Photons) -> None:
    """Write a configuration's photons into a batch's memory, except which of them a view sees."""
    for name, array in arrays_of(photons).items():
        getattr(memory, name)[place] = torch.from_numpy(array)
    memory.present[place] = memory.bounce[place] >= 0


def _fill_points(
    memory: PointInputs, place: int, position: F32, present: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> None:
    points = memory.position.shape[1]
    memory.position[place] = torch.from_numpy(position[:points])
    memory.present[place] = torch.from_numpy(present[:points])
    memory.seen[place] = torch.from_numpy(seen[:points])


def _fill_noisy(batch: TrainingBatch, place: int, kept: NDArray[np.bool_]) -> None:
    noisy = given(batch.inputs.noisy)
    noisy.kept[place] = torch.from_numpy(kept)
    torch.mul(batch.target[place, 0], noisy.kept[place, ..., None], out=noisy.colour[place])
