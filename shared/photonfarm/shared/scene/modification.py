"""The modification vector: where each movable group stands, and whether it is there at all.

Shape letters: N configurations; G movable groups of a scene, its objects first and then its lights, in the order of
the spec.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Key, make_key, uniform_of
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.spec import SceneSpec


@dataclass(frozen=True, slots=True, eq=False)
class Modification:
    """One configuration of a scene; all that is stored of it per sample."""

    translation: NDArray[np.float32]  # (G, 3) from the rest position, scene units
    present: NDArray[np.bool_]  # (G,) False: removed

    @property
    def vector(self) -> NDArray[np.float32]:
        """The modification as one array (G, 4): translation, then 1 if present, else 0."""
        return np.concatenate([self.translation, self.present[:, None].astype(np.float32)], axis=1)

    @classmethod
    def from_vector(cls, vector: NDArray[np.float32]) -> Modification:
        """The inverse of `vector`; (G, 4)."""
        return cls(np.ascontiguousarray(vector[:, :3], np.float32), vector[:, 3] != 0)

    def key(self, radiance_id: str) -> Key:
        """The content key of this configuration of that scene."""
        return modification_keys(radiance_id, self.vector[None])[0]


def rest(spec: SceneSpec) -> Modification:
    """The scene as it was modelled: nothing moved, nothing removed."""
    return Modification(np.zeros((len(spec.groups), 3), np.float32), np.ones(len(spec.groups), np.bool_))


def sample_modifications(spec: SceneSpec, seed: int, indices: Iterable[int]) -> F32:
    """The random configurations of a scene with these numbers under a master seed, as vectors (N, G, 4).

    Each group's position is uniform in its box and independent of the others; each is removed independently with its
    own probability; intersecting or unrealistic placements are not rejected [supplement 2.4]. A static scene gives the
    rest state. The position of a removed group is zeroed, so that equal configurations have equal keys.
    """
    radiance_id, count = spec.radiance_id, len(spec.groups)
    keys = [make_key("modification", radiance_id, seed, index) for index in indices]
    uniform = uniform_of(keys, "placement", 4 * count).reshape(len(keys), count, 4)
    vectors = np.zeros(uniform.shape, np.float32)
    for g, group in enumerate(spec.groups):
        position = group.box.low + uniform[:, g, :3] * (group.box.high - group.box.low)
        present = uniform[:, g, 3] >= group.removal_probability
        vectors[:, g, :3] = np.where(present[:, None], position - np.array(group.at), 0.0)
        vectors[:, g, 3] = present
    return vectors


def sample_modification(spec: SceneSpec, seed: int, index: int) -> Modification:
    """The `index`-th random configuration of a scene; see `sample_modifications`."""
    return Modification.from_vector(sample_modifications(spec, seed, [index])[0])


def modification_keys(radiance_id: str, vectors: F32) -> list[Key]:
    """The content keys of configurations (N, G, 4) of a scene."""
    return [make_key("modification", radiance_id, vector) for vector in vectors]
