"""The modification vector: where each movable group stands, and whether it is there at all.

Shape letters: G movable groups of a scene, its objects first and then its lights, in the order of the spec.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Key, Stream, make_key
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

    def key(self, scene_id: str) -> Key:
        """The content key of this configuration of that scene."""
        return make_key("modification", scene_id, self.vector)


def rest(spec: SceneSpec) -> Modification:
    """The scene as it was modelled: nothing moved, nothing removed."""
    return Modification(np.zeros((len(spec.groups), 3), np.float32), np.ones(len(spec.groups), np.bool_))


def sample_modification(spec: SceneSpec, seed: int, index: int) -> Modification:
    """The `index`-th random configuration of a scene under a master seed [supplement 2.4].

    Each group's position is uniform in its box and independent of the others; each is removed independently with its
    own probability; intersecting or unrealistic placements are not rejected. A static scene gives the rest state. The
    position of a removed group is zeroed, so that equal configurations have equal keys.
    """
    stream = Stream(make_key("modification", spec.scene_id, seed, index), "placement")
    modification = rest(spec)
    for i, group in enumerate(spec.groups):
        position = stream.uniform_in(group.box.low, group.box.high)
        modification.present[i] = stream.uniform(1)[0] >= group.removal_probability
        if modification.present[i]:
            modification.translation[i] = position - np.array(group.at)
    return modification
