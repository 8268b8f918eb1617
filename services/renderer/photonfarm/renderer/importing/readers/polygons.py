"""Polygons cut into triangles, and smooth normals. Letters: K corners of all polygons, N polygons, T triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.meshes import Floats, unit

Ints = NDArray[np.int64]

ROUNDING = 1e-6
"""The error of a polygon's area, as a share of it, from which its triangles do not fill it."""


def triangles(points: Floats, sizes: Ints) -> tuple[Ints, Ints, Floats, Ints]:
    """Polygons of `sizes` corners each (N,), whose points (K, 3) follow one another, as triangles.

    Returns their corners (T, 3), the polygon of each (T,), polygons' normals as long as twice their areas (N, 3), by
    Newell's formula, and the polygons that cross themselves. Those of fewer than three corners have no triangles.
    """
    starts, across, crossing = np.cumsum(sizes) - sizes, np.zeros((len(sizes), 3)), []
    corners, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(sizes[sizes > 2]):
        polygon = np.flatnonzero(sizes == size)
        corner = starts[polygon, None] + np.arange(size)
        at = points[corner] - points[corner[:, :1]]
        fan = np.cross(at[:, 1:-1], at[:, 2:])
        across[polygon] = area = fan.sum(axis=1)
        fans = (size == 3) | (np.einsum("nti,ni->nt", fan, area) > 0).all(axis=1)
        first = np.broadcast_to(corner[:, :1], (len(corner), size - 2))
        made = np.stack([first, corner[:, 1:-1], corner[:, 2:]], axis=-1)
        corners.append(made[fans].reshape(-1, 3))
        owners.append(np.repeat(polygon[fans], size - 2))
        for each in np.flatnonzero(~fans):
            cut, fills = _ears(at[each], area[each])
            corners.append(corner[each][cut])
            owners.append(np.full(len(cut), polygon[each]))
            if not fills:
                crossing.append(int(polygon[each]))
    return np.concatenate(corners), np.concatenate(owners), across, np.array(crossing, np.int64)


def _ears(points: Floats, across: Floats) -> tuple[Ints, bool]:
    """The triangles of one polygon, also one that is not convex, and whether they fill it."""
    from mapbox_earcut import triangulate_float64

    flat = np.ascontiguousarray(np.delete(points, np.abs(across).argmax(), axis=1))
    made = triangulate_float64(flat, np.array([len(points)], np.uint32)).reshape(-1, 3).astype(np.int64)
    if not len(made):
        made = np.array([[0, k, k + 1] for k in range(1, len(points) - 1)])
    a, b, c = points[made].swapaxes(0, 1)
    areas = np.cross(b - a, c - a) @ across
    made[areas < 0] = made[areas < 0, ::-1]
    whole = across @ across
    return made, bool(np.abs(np.abs(areas).sum() - whole) < ROUNDING * whole)


def smooth_normals(keys: Ints, across: Floats) -> tuple[Floats, NDArray[Any]]:
    """Normals of length 1 for distinct keys of corners (K,), each the mean by area, and which each corner has (K,)."""
    distinct, which = np.unique(keys, return_inverse=True)
    sums: Floats = np.zeros((len(distinct), 3))
    np.add.at(sums, which, across)
    return unit(sums), which
