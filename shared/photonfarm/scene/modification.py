"""The modification vector: where each movable group stands, and whether it is there at all; and a sample's point cloud.

The base cloud is sampled once per scene, and rebuilt for every configuration from its modification alone.

Shape letters: N configurations; G movable groups of a scene, its objects first and then its lights, in the order of
the spec; P points, F triangles, S shapes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key, Stream, make_key, uniform_of
from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry
from photonfarm.scene.spec import SceneSpec


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


def sample_surface(geometry: Geometry, count: int, stream: Stream) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """`count` points uniform over all triangles: their triangle (P,) and barycentric coordinates (P, 3).

    First a shape by its area, then a triangle of it by its area, then a point in it [supplement 2.3, Eq. 1].
    Eq. (2) as printed is off by one: the index drawn is min{k : u ≤ cdf(k)}. Shapes of no area are never drawn.
    """
    areas = geometry.areas()
    order = np.argsort(geometry.face_shape, kind="stable")  # triangles, shape by shape
    shape_area = np.zeros(len(geometry.shape_group))
    np.add.at(shape_area, geometry.face_shape, areas)
    shape = draw(shape_area, stream.uniform(count))

    first = np.concatenate([[0.0], np.cumsum(areas[order])])  # area before each triangle, in that order
    start = np.concatenate([[0], np.cumsum(np.bincount(geometry.face_shape, minlength=len(shape_area)))])
    u = first[start[shape]] + stream.uniform(count) * (first[start[shape + 1]] - first[start[shape]])
    # u = 0 is found in the triangle before the shape's first, and rounding may pass its last
    place = np.clip(np.searchsorted(first[1:], u, side="left"), start[shape], start[shape + 1] - 1)
    return order[place].astype(np.uint32), _barycentric(stream.uniform(2, count))


def draw(weights: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices drawn in proportion to `weights`: min{k : u ≤ cdf(k)}, by bisection; never one of weight 0."""
    cdf = np.cumsum(weights) / np.sum(weights)
    positive = np.flatnonzero(weights > 0)
    return positive[np.minimum(np.searchsorted(cdf[positive], u, side="left"), len(positive) - 1)]


def _barycentric(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Uniform in a triangle from two uniform numbers, (2, P) → (P, 3) (Turk, Graphics Gems, 1990)."""
    root = np.sqrt(u[0])
    return np.stack([1 - root, root * (1 - u[1]), root * u[1]], axis=1)


def rebuild(base: BasePointCloud, modification: Modification) -> tuple[F32, NDArray[np.bool_]]:
    """The position (P, 3) of each point in one configuration, and whether it is present (P,) [supplement 1.1, 2.1].

    Points of a moved group move by its translation, in float32; points of a removed group stay where they are and are
    not present, so that P is constant.
    """
    moves = base.group != STATIC
    group = np.where(moves, base.group, 0)
    if not len(modification.present):
        return base.position, np.ones(len(base.position), np.bool_)
    shift = np.where(moves[:, None], modification.translation[group], np.float32(0))
    return base.position + shift, ~moves | modification.present[group]
