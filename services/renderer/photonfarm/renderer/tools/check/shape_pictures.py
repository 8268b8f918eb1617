"""A picture of each shape alone, seen from above one corner, and the colours of all shapes.

Shape letters: S shapes.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.pictures import Picture, display_values
from photonfarm.core.records import F32, Geometry
from photonfarm.renderer.scene.arrays import rows
from photonfarm.renderer.scene.base_cloud import surfaces_at
from photonfarm.renderer.scene.gbuffer import diffuse_reflectance
from photonfarm.renderer.tools.check.orthographic import Projection, alone

WIDTH = 88

FACES = 16
"""The triangles of a shape whose colours are looked at."""

GREY = 0.6
"""The colour of shapes without a diffuse part: glass, mirrors, metals."""


def colours(scene: Any, geometry: Geometry) -> F32:
    """A colour for each shape of a scene at rest, as displays are given it, (S, 3): its mean diffuse reflectance."""
    count = len(geometry.shape_group)
    first, last = (np.searchsorted(geometry.face_shape, np.arange(count), side) for side in ("left", "right"))
    face = np.linspace(first, np.maximum(last - 1, first), FACES).T.ravel().astype(np.uint32)
    with np.errstate(invalid="ignore"):  # triangles without an area
        _, si = surfaces_at(scene, geometry, face, np.full((len(face), 3), 1 / 3))
    albedo = diffuse_reflectance(si, mi.Bool(True))
    dr.eval(albedo)
    mean = np.nan_to_num(rows(albedo, count, FACES)).mean(axis=1)
    return np.where(mean.max(axis=1, keepdims=True) > 0, 0.12 + 0.88 * display_values(mean), GREY).astype(np.float32)


def picture(geometry: Geometry, number: int, colour: F32, up: int) -> Picture:
    """One shape alone, in one colour (3,)."""
    first, last = np.searchsorted(geometry.face_shape, [number, number + 1])
    used, faces = np.unique(geometry.faces[first:last], return_inverse=True)
    vertices = geometry.vertices[used]
    box = np.array([vertices.min(axis=0), vertices.max(axis=0)], np.float64)
    middle, radius = box.mean(axis=0), max(0.5 * float(np.linalg.norm(box[1] - box[0])), 1e-9)
    right, down, forward = _from_a_corner(up)
    centre = np.array([middle @ right, middle @ down])
    start = float(middle @ forward) - 2 * radius
    projection = Projection(right, down, forward, centre - radius, centre + radius, start)
    return alone(vertices, faces.reshape(-1, 3).astype(np.uint32), projection, WIDTH, colour)


def _from_a_corner(up: int) -> tuple[Any, Any, Any]:
    """Right, down and forward of a viewer above a corner, where axis `up` points up."""
    across, along = (np.eye(3)[axis] for axis in range(3) if axis != up)
    upwards = np.eye(3)[up]
    if np.cross(upwards, across) @ along < 0:
        along = -along
    forward = -(0.55 * across + 0.65 * along + 0.6 * upwards)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, upwards)
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right), forward
