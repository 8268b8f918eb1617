"""What the trainer reads: samples from a store that grows, split by configuration, as arrays ready for a batch.

Shape letters: B batch, P points, H W image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.shared.hold_out import are_held_out
from photonfarm.shared.keys import Key, make_key
from photonfarm.shared.modification import Modification
from photonfarm.shared.pointcloud import rebuild
from photonfarm.shared.records import F32, BasePointCloud, Geometry, ViewBuffers
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.view import Camera, View
from photonfarm.trainer.model import Inputs


class Sample(Protocol):
    """One sample as it is read."""

    @property
    def modification(self) -> Modification:
        """The configuration."""

    @property
    def view(self) -> View:
        """The view."""

    @property
    def radiance(self) -> F32:
        """Half-estimates A and B, (2, H, W, 3), linear."""

    @property
    def buffers(self) -> ViewBuffers:
        """The image-space buffers."""


class SampleSource(Protocol):
    """The samples of one scene: the store's reader, or anything that behaves like it. Used by one thread at a time."""

    def ready(self) -> bool:
        """Whether spec and base are there; they come with the scene's first job."""

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec."""

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """The geometry and the base cloud."""

    def refresh(self) -> NDArray[np.int64]:
        """The rows that became complete since the last call."""

    def taken_back(self) -> NDArray[np.int64]:
        """The rows that were complete before the last `refresh` and not after it; they become complete once more."""

    def read(self, row: int) -> Sample:
        """A complete row's sample; raises StoreError if it is not, or cannot be read."""

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration."""

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        """The content key of each row's configuration and view."""

    def planned(self) -> int:
        """The number of samples in all plans so far, complete or not."""


def rows_held_out(source: SampleSource, rows: Sequence[int], share: float) -> list[bool]:
    """Whether each row is kept from training, not by when it arrived but by what it is.

    All views and passes of a configuration are on one side. A static scene has one configuration; there the view
    decides, and all passes of a view are on one side.
    """
    return are_held_out(source.modification_keys(rows) if source.spec.groups else source.view_keys(rows), share)


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Samples as tensors; valid until the next one is taken. Those that were not complete are left out, maybe all."""

    rows: tuple[int, ...]
    units: tuple[Key, ...]  # what each is held out by: equal for samples that are not independent
    inputs: Inputs
    target: Tensor  # (B, 2, H, W, 3) half-estimates A and B, linear radiance × exposure

    @classmethod
    def empty(cls, size: int, points: int, spec: SceneSpec, *, pinned: bool = False) -> Batch:
        """Memory for `size` samples, to be filled again and again."""

        def memory(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.empty(size, *shape, dtype=dtype, pin_memory=pinned)

        film = (spec.film.height, spec.film.width)
        inputs = Inputs(
            position=memory(points, 3),
            visible=memory(points, dtype=torch.bool),
            world_to_camera=memory(3, 4),
            depth=memory(*film),
            albedo=memory(*film, 3),
            normal=memory(*film, 3),
        )
        return cls((), (), inputs, memory(2, *film, 3))

    def filled(self, rows: tuple[int, ...], units: tuple[Key, ...]) -> Batch:
        """The first samples of this memory, named by their rows and what they are held out by."""
        n = len(rows)
        i = self.inputs
        inputs = Inputs(i.position[:n], i.visible[:n], i.world_to_camera[:n], i.depth[:n], i.albedo[:n], i.normal[:n])
        return Batch(rows, units, inputs, self.target[:n])

    def to(self, device: torch.device) -> Batch:
        """The same batch on a device; itself on the CPU."""
        i = self.inputs
        tensors = (i.position, i.visible, i.world_to_camera, i.depth, i.albedo, i.normal)
        return Batch(self.rows, self.units, Inputs(*(t.to(device) for t in tensors)), self.target.to(device))


@dataclass(frozen=True, slots=True, eq=False)
class Compact:
    """A sample as it is kept in memory: float16 wherever that changes no bit, float32 elsewhere."""

    modification: Modification
    view: View
    unit: Key  # of the configuration, or of the view in a static scene
    radiance: NDArray[np.floating]  # × 2^radiance_exponent, as it is stored
    depth: NDArray[np.floating]
    albedo: NDArray[np.floating]
    normal: NDArray[np.floating]

    @classmethod
    def of(cls, sample: Sample, spec: SceneSpec) -> Compact:
        """The sample in as few bytes as hold it exactly."""
        scaled = sample.radiance * np.float32(2.0**spec.radiance_exponent)
        b = sample.buffers
        unit = sample.modification.key(spec.scene_id) if spec.groups else make_key(sample.view.vector)
        images = (_smallest(x) for x in (scaled, b.depth, b.albedo, b.normal))
        return cls(sample.modification, sample.view, unit, *images)

    @property
    def nbytes(self) -> int:
        """Bytes of its images."""
        return self.radiance.nbytes + self.depth.nbytes + self.albedo.nbytes + self.normal.nbytes


def _smallest(array: F32) -> NDArray[np.floating]:
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    return half if np.array_equal(half, array) else array.copy()


def fill(batch: Batch, place: int, sample: Compact, spec: SceneSpec, cloud: BasePointCloud) -> None:
    """Write one sample into a batch's memory: its cloud rebuilt, its camera, its buffers, its exposed targets."""
    i = batch.inputs
    points = i.position.shape[1]
    position, visible = rebuild(cloud, sample.modification)
    i.position[place] = torch.from_numpy(position[:points])
    i.visible[place] = torch.from_numpy(visible[:points])
    i.world_to_camera[place] = torch.from_numpy(Camera.of(sample.view, spec).world_to_camera)
    for memory, array in ((i.depth, sample.depth), (i.albedo, sample.albedo), (i.normal, sample.normal)):
        memory[place] = torch.from_numpy(array)
    exposed = spec.exposure / 2.0**spec.radiance_exponent
    torch.mul(torch.from_numpy(sample.radiance).float(), exposed, out=batch.target[place])
