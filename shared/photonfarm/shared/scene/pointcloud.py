"""The base point cloud: sampled once per scene, and rebuilt for every configuration from its modification alone.

Shape letters: P points, F triangles, S shapes, G movable groups.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Stream
from photonfarm.shared.core.records import F32, STATIC, BasePointCloud, Geometry
from photonfarm.shared.scene.modification import Modification


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
