"""What is seen from where, by one shadow ray to each point: exact, and free of noise. Shape letter: N points.

A depth buffer is less exact: a point's pixel also shows what is before and behind it, and a surface seen at an angle
has many depths within a pixel.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.arrays import floats, points
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import Camera, View

SELF_HIT = 1e-4
"""The share of its length by which a ray ends before its point, so that it does not meet the point's surface."""


def seen_points(scene: Any, view: View, spec: SceneSpec, position: F32) -> NDArray[np.bool_]:
    """Whether a view sees points (N, 3) of the present scene, (N,), by the definition of `records.Visibility`.

    There is a ray for every point, so that the number of rays depends on no view; those to points outside the image
    are switched off.
    """
    camera = Camera.of(view, spec)
    offset = position - camera.origin
    z = offset @ camera.forward
    ahead = (z > spec.view.near) & (z < spec.view.far)
    z = np.where(ahead, z, 1.0)
    u, v = (camera.focal_px * (offset @ axis) / z for axis in (camera.right, camera.down))
    in_image = ahead & _within(u, camera.width) & _within(v, camera.height)

    distance = np.where(ahead, np.linalg.norm(offset, axis=1), 1.0)
    direction = offset / distance[:, None]
    near = spec.view.near * distance / z  # at which the line to the point crosses the near plane
    ray = mi.Ray3f(o=points(camera.origin + near[:, None] * direction), d=mi.Vector3f(points(direction)))
    ray.maxt = floats(np.where(in_image, (1 - SELF_HIT) * distance - near, 0.0))
    hidden = scene.ray_test(ray, active=ray.maxt > 0)
    return in_image & ~np.array(hidden)


def sight_shares(scene: Any, origins: F32, targets: F32) -> F32:
    """The share of targets (L, 3) that each of the origins (N, 3) has an unobstructed line to, (N,)."""
    start, end = origins.repeat(len(targets), axis=0), np.tile(targets, (len(origins), 1))
    distance = np.maximum(np.linalg.norm(end - start, axis=1), np.float32(1e-30))
    ray = mi.Ray3f(o=points(start), d=mi.Vector3f(points((end - start) / distance[:, None])))
    ray.maxt = floats(distance)
    blocked = np.array(scene.ray_test(ray)).reshape(len(origins), len(targets))
    return 1 - blocked.mean(axis=1, dtype=np.float32)


def _within(place: NDArray[np.float64], pixels: int) -> NDArray[np.bool_]:
    """Whether places along one axis, in pixels from the image's centre, are in one of its pixels."""
    found: NDArray[np.bool_] = (place >= -0.5 * pixels) & (place < 0.5 * pixels)
    return found
