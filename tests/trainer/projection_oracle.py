"""What a view sees of points, by brute force: every line of sight against every triangle, in float64, by numpy alone.

Shape letters: F triangles, P points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32, STATIC, Geometry
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera

F64 = NDArray[np.float64]

SELF_HIT = 1e-4
"""The share of its length by which a line of sight ends before its point, so that it misses the point's own surface."""

AT_ONCE = 8192
"""The number of triangles tested at a time, so that intermediate results stay in the processor's cache."""

TOGETHER = 16
"""The largest number of lines that are tested against the same triangles."""

ROUNDING = 1e-9
"""The tolerance for directions, by which a triangle that touches the outermost line is in its way."""


def triangles(geometry: Geometry, modification: Modification) -> F64:
    """The corners of a configuration's triangles, (F, 3 corners, 3): groups moved, those removed left out."""
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    group = geometry.shape_group[geometry.face_shape]
    if not len(modification.present):
        return corners
    moves = group != STATIC
    corners[moves] += modification.translation[group[moves], None]
    return corners[~moves | modification.present[group]]


def in_camera(camera: Camera, position: NDArray[np.floating]) -> F64:
    """World positions (…, 3) in camera coordinates: right, down, forward."""
    axes = np.stack([camera.right, camera.down, camera.forward], axis=1)
    return (position.astype(np.float64) - camera.origin) @ axes


def in_image(camera: Camera, spec: SceneSpec, position: F32) -> NDArray[np.bool_]:
    """Which points lie between the near and the far plane, and by floor in a pixel of the image, (P,)."""
    at = in_camera(camera, position)
    ahead = (at[:, 2] > spec.view.near) & (at[:, 2] < spec.view.far)
    centre, size = np.array([camera.width, camera.height]) / 2, np.array([camera.width, camera.height])
    pixel = np.floor(camera.focal_px * at[:, :2] / np.where(ahead, at[:, 2], 1)[:, None] + centre)
    found: NDArray[np.bool_] = ahead & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
    return found


def first_met(corners: F64, camera: Camera, spec: SceneSpec, position: F32) -> F64:
    """Where the lines from the eye to points in the image first meet a triangle beyond the near plane, (P,).

    In shares of the distance to the point, so that its own surface is at 1; ∞ where they meet none.
    """
    ends = in_camera(camera, position)
    return _first(in_camera(camera, corners), ends, spec.view.near / ends[:, 2])


def _first(corners: F64, ends: F64, near: F64) -> F64:
    """`first_met` in camera coordinates. Lines are split in halves, so that each meets few triangles off its way."""
    found = np.full(len(ends), np.inf)
    if not len(ends):
        return found
    rest, at = _in_the_way(corners, ends), ends[:, :2] / ends[:, 2:]
    if len(ends) > TOGETHER:
        for half in np.array_split(np.argsort(at[:, np.ptp(at, axis=0).argmax()]), 2):
            found[half] = _first(rest, ends[half], near[half])
        return found
    for start in range(0, len(rest), AT_ONCE):
        point, share = _met(rest[start : start + AT_ONCE], ends)
        beyond = share >= near[point]
        np.minimum.at(found, point[beyond], share[beyond])
    return found


def _in_the_way(corners: F64, ends: F64) -> F64:
    """Those of the triangles that a line may meet: not beyond one side of the pyramid of all lines with all corners."""
    x, y, z = np.moveaxis(corners, -1, 0)
    at = ends[:, :2] / ends[:, 2:]
    low, high = at.min(axis=0) - ROUNDING, at.max(axis=0) + ROUNDING
    beyond = [x > high[0] * z, x < low[0] * z, y > high[1] * z, y < low[1] * z, z < 0]
    return corners[~np.any([side.all(axis=1) for side in beyond], axis=0)]


def _met(corners: F64, ends: F64) -> tuple[NDArray[np.int64], F64]:
    """Which lines from the origin through `ends` meet which triangles, and where: points and shares, (N,) each.

    By the barycentric coordinates of Möller and Trumbore (1997), of lines d that have one origin: that of corner c is
    d · (a × b) over the sum of all three, which is d · n; the share is c · (a × b) over it. An edge is of both sides.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    edges = [np.cross(one, other) for one, other in ((a, b), (b, c), (c, a))]
    weights = [edge @ ends.T for edge in edges]
    least, most = (extreme(extreme(weights[0], weights[1]), weights[2]) for extreme in (np.minimum, np.maximum))
    triangle, point = np.nonzero(((least >= 0) | (most <= 0)) & (most > least))
    total = sum(weight[triangle, point] for weight in weights)
    return point, (c * edges[0]).sum(axis=1)[triangle] / total


def sees(corners: F64, camera: Camera, spec: SceneSpec, position: F32) -> NDArray[np.bool_]:
    """Which points a camera sees, (P,), as `photonfarm.core.records.Visibility` defines it."""
    found = in_image(camera, spec, position)
    found[found] = first_met(corners, camera, spec, position[found]) > 1 - SELF_HIT
    return found
