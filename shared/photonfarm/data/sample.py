"""One sample of a scene, with everything that the store holds of it.

Shape letters: H W image, G movable groups, P points of the cloud, K photon slots.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Key, seed_of
from photonfarm.shared.core.records import F32, BasePointCloud, Guides, Photons, arrays_of
from photonfarm.shared.plan.request import sample_key
from photonfarm.shared.scene.modification import Modification
from photonfarm.shared.scene.pointcloud import rebuild
from photonfarm.shared.scene.view import View
from photonfarm.shared.store.read.reader import SceneReader, StoredSample

IMAGES = ("radiance", "albedo", "normal", "depth")
"""The images that every sample has, beside those that `Guides` names."""


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """The P points of a scene in the configuration of one sample: the scene's own points, moved with their groups.

    position: (P, 3) float32, world coordinates in scene units.
    normal: (P, 3) float32, geometric unit normals in world coordinates.
    albedo: (P, 3) float32, diffuse reflectance.
    emission: (P, 3) float32, radiance that leaves along the normal, linear RGB.
    present: (P,) bool, False for points of removed groups.
    seen: (P,) bool, whether the view sees the point: it is in the image, and nothing hides it.
    """

    position: F32
    normal: F32
    albedo: F32
    emission: F32
    present: NDArray[np.bool_]
    seen: NDArray[np.bool_]


class Sample:
    """One complete sample. Its images are read when it is made, the point cloud and photons when they are asked for.

    Images are float32, rows from top to bottom, and linear; nothing is clipped.
    """

    def __init__(self, stored: StoredSample, reader: SceneReader, scene_id: str, base: BasePointCloud) -> None:
        """Wrap what the reader gave; use `Scene` to get samples."""
        self._stored, self._reader, self._scene_id, self._base = stored, reader, scene_id, base

    def __repr__(self) -> str:
        return f"<sample {self.row} of scene {self._scene_id}, pass {self.pass_number}>"

    def __getattr__(self, name: str) -> Any:
        """A guide by its name, such as `direct`; AttributeError with the names that exist."""
        guides = {} if name.startswith("_") else self.guides
        if name in guides:
            return guides[name]
        exist = ", ".join(sorted([*(each for each in dir(type(self)) if not each.startswith("_")), *guides]))
        raise AttributeError(f"a sample has no {name!r}; it has {exist}", name=name, obj=self)

    # --------------------------------------------------------------------------------------------------------- identity

    @property
    def row(self) -> int:
        """The row of the sample in the store, which never changes."""
        return self._stored.row

    @property
    def modification(self) -> Modification:
        """The configuration: `translation` (G, 3) in scene units from the rest position, and `present` (G,)."""
        return self._stored.modification

    @property
    def view(self) -> View:
        """The camera's origin and target, world coordinates in scene units."""
        return self._stored.view

    @property
    def pass_number(self) -> int:
        """The number of the noisy pass, from 0: passes of one view differ in their noise alone."""
        return self._stored.pass_

    @property
    def key(self) -> Key:
        """The content key: 16 bytes, a hash of scene, modification, view and pass."""
        return sample_key(self._reader.spec.radiance_id, self.modification, self.view.vector, self.pass_number)

    @property
    def seeds(self) -> tuple[int, int]:
        """The seeds of the halves A and B, 32 bits each, functions of the key.

        A render that was not finite has been drawn again with another seed; the job's marker counts these.
        """
        return seed_of(self.key, "half A"), seed_of(self.key, "half B")

    # ----------------------------------------------------------------------------------------------------------- images

    @property
    def radiance(self) -> F32:
        """Two independent noisy estimates A and B of the same image, (2, H, W, 3) linear RGB radiance."""
        return self._stored.radiance

    @property
    def albedo(self) -> F32:
        """Diffuse reflectance of what the view sees, (H, W, 3) in 0 … 1, the mean over each pixel."""
        return self._stored.buffers.albedo

    @property
    def normal(self) -> F32:
        """Shading normals at the pixels' centres, (H, W, 3), unit, world coordinates; zero where nothing is hit."""
        return self._stored.buffers.normal

    @property
    def depth(self) -> F32:
        """Depth along the camera's forward axis, (H, W) in scene units; zero where nothing is hit."""
        return self._stored.buffers.depth

    @property
    def guides(self) -> dict[str, F32]:
        """The guides, images that networks may be given, by name; empty if the scene was opened without.

        `photonfarm.shared.core.records.Guides` describes each. A guide is also an attribute of the sample.
        """
        known: Guides | None = self._stored.guides
        return {} if known is None else {name: np.asarray(array) for name, array in arrays_of(known).items()}

    # ----------------------------------------------------------------------------------------------- points and photons

    @cached_property
    def point_cloud(self) -> PointCloud:
        """The scene's points as this configuration has them, and which of them the view sees."""
        position, present = rebuild(self._base, self.modification)
        base, seen = self._base, self._stored.visibility.points
        return PointCloud(position, base.normal, base.albedo, base.emission, present, seen)

    @cached_property
    def photons(self) -> Photons:
        """The photons of this configuration, K slots; StoreError for a scene without photons."""
        return self._reader.read_photons(self.row)

    @property
    def seen_photons(self) -> NDArray[np.bool_]:
        """Whether the view sees each photon, (K,); (0,) for a scene without photons."""
        return self._stored.visibility.photons
