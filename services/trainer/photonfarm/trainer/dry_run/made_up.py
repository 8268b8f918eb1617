"""A made-up scene and made-up samples, with the sizes of a spec: steps on them take as long as on stored ones.

Shape letters: B batch, P points, K photon slots, L lit points, H W image.

Memory is that which tensors hold at most while something is computed, counted as they come and go.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import product
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.trainer.data.batch import TrainingBatch, allocate_memory
from photonfarm.trainer.networks import find_kind
from photonfarm.trainer.networks.inputs import Inputs
from photonfarm.trainer.runs.settings import TrainSettings

METALS = 0.2
"""The share of pixels whose specular albedo lets `guided_transport` sum light over their lobe."""


@dataclass(frozen=True, slots=True, eq=False)
class MadeUpScene:
    """A cube of side 2 about the origin, seen from inside, whose points are as many as the spec's."""

    spec: SceneSpec
    geometry: Geometry
    cloud: BasePointCloud

    @classmethod
    def of(cls, spec: SceneSpec) -> Self:
        """The scene for a spec; always the same."""
        rng = np.random.default_rng(0)
        corners = np.array(list(product((-1.0, 1.0), repeat=3)), np.float32)
        faces = np.array([(0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6)], np.uint32)
        geometry = Geometry(corners, faces, np.zeros(4, np.int32), np.array([STATIC], np.int16))
        axis, side = rng.integers(0, 3, spec.points), rng.choice([-1.0, 1.0], spec.points)
        position, normal = rng.uniform(-1, 1, (spec.points, 3)), np.zeros((spec.points, 3), np.float32)
        every = np.arange(spec.points)
        position[every, axis], normal[every, axis] = side, -side
        group, face = np.full(spec.points, STATIC, np.int16), np.zeros(spec.points, np.uint32)
        albedo, emission = (rng.random((spec.points, 3), np.float32) for _ in range(2))
        return cls(spec, geometry, BasePointCloud(position.astype(np.float32), normal, albedo, emission, group, face))

    def batch(self, size: int, settings: TrainSettings) -> TrainingBatch:
        """A batch of so many samples, with all that the settings' network reads; half of the points are seen."""
        spec, needs = self.spec, find_kind(settings.network.architecture).needs
        tensors = allocate_memory(SampleTensors(spec, needs.fields, points=settings.network.points), size)
        generator = torch.Generator().manual_seed(0)
        for tensor in tensors.values():
            _fill(tensor, generator)
        kept = torch.rand(size, spec.film.height, spec.film.width, generator=generator) < 0.5 if needs.kept else None
        batch = TrainingBatch.of(range(size), (b"made up",) * size, tensors, kept)
        self._make_plausible(batch.inputs, generator)
        return batch

    def _make_plausible(self, inputs: Inputs, generator: torch.Generator) -> None:
        """Cameras within the cube, unit normals, points and photons on its walls, and as many metals as usual."""
        views = 0.5 * torch.rand(len(inputs.depth), 2, 3, generator=generator).numpy()
        for place, (origin, target) in enumerate(views):
            camera = Camera.of(View(origin - 0.5, target + 0.5), self.spec)
            inputs.world_to_camera[place] = torch.from_numpy(camera.world_to_camera)
        inputs.depth.add_(0.5)
        _to_unit(inputs.normal)
        if inputs.points is not None:
            inputs.points.position[:] = torch.from_numpy(self.cloud.position[: inputs.points.position.shape[1]])
            inputs.points.present.fill_(True)
        if (photons := inputs.photons) is not None:
            photons.position[:] = torch.from_numpy(_repeat_rows(self.cloud.position, photons.position.shape[1]))
            photons.normal[:] = torch.from_numpy(_repeat_rows(self.cloud.normal, photons.normal.shape[1]))
            photons.direction[:] = -photons.normal
            photons.bounce.mul_(self.spec.photons.depth).floor_()
            photons.present.fill_(True)
        if (guides := inputs.guides) is not None:
            guides.specular.mul_((torch.rand(guides.roughness.shape, generator=generator) < METALS)[..., None])
            for vectors in (guides.mean_normal, guides.beyond_normal):
                _to_unit(vectors)


def _fill(tensor: Tensor, generator: torch.Generator) -> Tensor:
    """Fill a tensor with numbers uniform in [0, 1), or with flags of which half are set."""
    values = torch.rand(tensor.shape, generator=generator)
    return tensor.copy_(values < 0.5 if tensor.dtype == torch.bool else values)


def _to_unit(vectors: Tensor) -> None:
    vectors.sub_(0.5).div_(torch.linalg.vector_norm(vectors, dim=-1, keepdim=True))


def _repeat_rows(values: F32, count: int) -> F32:
    """The first `count` rows, from the beginning again if there are fewer."""
    return np.resize(values, (count, *values.shape[1:]))


class LiveMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the bytes of all tensors that operations make, from when they are made until they are freed.

    What is there before does not count, nor what an operation takes and frees within itself. On a card torch's own
    count is better, but a network whose batch does not fit has none.
    """

    def __init__(self, but_for: Collection[torch.Size] = ()) -> None:
        """Leave out tensors of the shapes `but_for`."""
        super().__init__()  # type: ignore[no-untyped-call]
        self._but_for = frozenset(but_for)
        self._live: dict[int, int] = {}  # bytes of each piece of memory, by its place
        self._bytes = 0
        self.peak_bytes = 0

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Compute an operation, and count what it made."""
        given = {_find_place(tensor) for tensor in tree_leaves((args, kwargs)) if isinstance(tensor, Tensor)}
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, Tensor) and tensor.shape not in self._but_for and _find_place(tensor) not in given:
                self._add(tensor)
        self.peak_bytes = max(self.peak_bytes, self._bytes)
        return made

    def _add(self, tensor: Tensor) -> None:
        storage, place = tensor.untyped_storage(), _find_place(tensor)
        if place in self._live:
            return
        self._live[place] = storage.nbytes()
        self._bytes += storage.nbytes()
        weakref.finalize(storage, self._free, place)

    def _free(self, place: int) -> None:
        self._bytes -= self._live.pop(place, 0)


def _find_place(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()
