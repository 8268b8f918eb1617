"""Rooms as the product samples them: which points are seen in a view, and which of them the projection keeps.

Shape letters: P points, J points that are judged, H W image.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness.scenes import ready_spec, square
from bench.trainer.projection_oracle import in_image, sees, triangles
from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry, ViewBuffers
from photonfarm.scene.modification import rebuild, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View, sample_view
from photonfarm.trainer.networks.projection import Optics, footprint
from photonfarm.trainer.runs.settings import Occlusion

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Counts:
    """Points in the image: those that are seen, those that the projection keeps, and those in both."""

    seen: int = 0
    kept: int = 0
    both: int = 0

    @classmethod
    def of(cls, seen: Mask, kept: Mask) -> Counts:
        """The counts of two masks over the same points."""
        return cls(int(seen.sum()), int(kept.sum()), int((seen & kept).sum()))

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.seen + other.seen, self.kept + other.kept, self.both + other.both)

    @property
    def recall(self) -> float:
        """Share of the points seen that are kept; 1 where there are none."""
        return self.both / self.seen if self.seen else 1.0

    @property
    def leak(self) -> float:
        """Share of the points kept that are not seen; 0 where there are none."""
        return 1 - self.both / self.kept if self.kept else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewed:
    """One view of one configuration of a room."""

    camera: Camera
    position: F32  # (P, 3)
    present: Mask  # (P,) not of a removed group
    moved: Mask  # (P,) of a group that stands elsewhere than at rest
    seen: Mask  # (P,) as the renderer stores it
    query_s: float  # CPU seconds that it took
    buffers: ViewBuffers
    judged: NDArray[np.int64]  # (J,) points in the image, chosen at random
    truth: Mask  # (J,) whether the oracle sees them

    def kept(self, optics: Optics) -> Mask:
        """What the projection keeps, (P,)."""
        to_camera = self.camera.world_to_camera.astype(np.float32)
        arrays = (self.position, self.present, self.seen, to_camera, self.buffers.depth, self.buffers.normal)
        position, present, seen, camera, depth, normal = (torch.from_numpy(array)[None] for array in arrays)
        found = np.zeros(len(self.position), np.bool_)
        found[footprint(position, present, seen, camera, depth, normal, optics).point.numpy()] = True
        return found


@dataclass(frozen=True, slots=True, eq=False)
class LoadedRoom:
    """A room that is loaded, with its base cloud."""

    spec: SceneSpec
    loaded: Any  # LoadedScene
    geometry: Geometry
    cloud: BasePointCloud

    @classmethod
    def load(cls, name: str, points: int, size: int) -> LoadedRoom:
        """A built-in room, or one of `scenes/`, with a square film; SpecError where it is not in PHOTONFARM_SCENES."""
        from photonfarm.renderer.scene.loaded_scene import LoadedScene

        spec = square(ready_spec(name), size).model_copy(update={"points": points})
        loaded = LoadedScene.load(spec)
        return cls(spec, loaded, *loaded.base())

    def optics(self, occlusion: Occlusion) -> Optics:
        """What the trainer makes of the spec."""
        return replace(Optics.of(self.spec), occlusion=occlusion)

    def views(self, count: int, judged: int) -> Iterator[Viewed]:
        """Random views, two of each random configuration, in each of which the oracle judges so many points."""
        rng = np.random.default_rng(0)
        for index in range(count):
            modification = sample_modification(self.spec, 0, index // 2)
            self.loaded.apply(modification)
            corners = triangles(self.geometry, modification)
            view = sample_view(self.spec, modification.key(self.spec.radiance_id), 0, index)
            position, present = rebuild(self.cloud, modification)
            camera = Camera.of(view, self.spec)
            inside = np.flatnonzero(present & in_image(camera, self.spec, position))
            some = rng.choice(inside, min(judged, len(inside)), replace=False)
            seen, query_s = self._query(view, position)
            yield Viewed(
                camera=camera,
                position=position,
                present=present,
                moved=(self.cloud.group != STATIC) & present & (position != self.cloud.position).any(axis=1),
                seen=seen & present,
                query_s=query_s,
                buffers=self.loaded.buffers(view),
                judged=some,
                truth=sees(corners, camera, self.spec, position[some]),
            )

    def _query(self, view: View, position: F32) -> tuple[Mask, float]:
        began = time.process_time()
        return self.loaded.sees(view, position), time.process_time() - began
