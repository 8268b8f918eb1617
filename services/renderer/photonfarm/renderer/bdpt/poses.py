"""Several cameras in one launch: one sensor, and where it stands for each image.

The sensor itself stands at the origin and looks along +z. Rays leave it there and are brought into the world; points of
the world are brought to it. So any sensor that ``bdpt`` accepts can be posed, and computes its importance itself. The
arithmetic is that of Mitsuba's ``perspective`` in the same order, so that on a processor images are those of a sensor
that is moved by its own ``to_world``, mostly to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

Places = npt.NDArray[np.floating[Any]]
"""Camera-to-world matrices [K, 4, 4], one for each image.

The axes across and up are of unit length or, for a field of view wider than the sensor's, longer, by how much wider the
image plane is.
"""

RIGID = 1e-6
"""How far the length of an axis may be from 1 by rounding alone."""


@dataclass(slots=True)
class Poses:
    """Where the cameras of K images stand."""

    to_world: list[mi.Vector3f]  # [K] each: the columns of the matrices, the camera's x, y, z and its origin
    to_camera: list[mi.Vector3f]  # [K] each: those of their inverses
    widths: mi.Float | None  # [K]: of the image planes, over that of the sensor; None: all are the sensor's

    @classmethod
    def of(cls, places: Places) -> Poses:
        """The poses as device data."""
        length, widths = np.linalg.norm(places[:, :3, 0], axis=1), None
        if (np.abs(length - 1) > RIGID).any():
            places = places.copy()
            places[:, :3, :2] /= length[:, None, None]
            widths = mi.Float(length.tolist())
            dr.make_opaque(widths)
        matrix = mi.Matrix4f(*(mi.Float(places[:, row, column].tolist()) for row in range(4) for column in range(4)))
        dr.make_opaque(matrix)  # a single pose would be a literal
        transform = mi.AffineTransform4f(matrix)
        poses = cls(_columns(transform), _columns(transform.inverse()), widths)
        dr.eval(poses)
        return poses


def _columns(transform: mi.AffineTransform4f) -> list[mi.Vector3f]:
    return [mi.Vector3f(*(transform.matrix[row, column] for row in range(3))) for column in range(4)]


@dataclass(slots=True)
class PosedSensor:
    """A sensor at the poses of the images that lanes belong to; it has what ``bdpt`` uses of a sensor."""

    sensor: mi.Sensor
    poses: Poses
    image: mi.UInt32  # the number of each lane's image

    def film(self) -> mi.Film:
        """The film, which all images share."""
        return self.sensor.film()

    def near_clip(self) -> float:
        """The distance of the near plane."""
        return float(self.sensor.near_clip())

    def needs_aperture_sample(self) -> bool:
        """Whether rays start at different points of a lens."""
        return bool(self.sensor.needs_aperture_sample())

    def sample_ray(
        self, time: float, wavelengths: float, position: mi.Point2f, aperture: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray through a position of the film, and its weight, as ``mi.Sensor.sample_ray`` returns them."""
        if self.poses.widths is not None:  # the sensor's own image plane goes on beyond its film
            position = 0.5 + (position - 0.5) * dr.gather(mi.Float, self.poses.widths, self.image)
        ray, weight = self.sensor.sample_ray(time, wavelengths, position, aperture, active)
        to_near = self.sensor.near_clip() * dr.rcp(ray.d.z)
        *axes, origin = self._gather_columns(self.poses.to_world)
        d = _turn_to_world(axes, ray.d)
        lens = _turn_to_world(axes, ray.o - ray.d * to_near)  # 0 of a pinhole
        return mi.Ray3f(origin + lens + d * to_near, d, ray.maxt, ray.time, ray.wavelengths), weight

    def sample_direction(
        self, it: mi.Interaction3f, aperture: mi.Point2f, active: mi.Bool | bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """The lens seen from a point, as ``mi.Sensor.sample_direction`` returns it."""
        *axes, moved = self._gather_columns(self.poses.to_camera)
        seen_from = dr.zeros(mi.Interaction3f)
        seen_from.p = dr.fma(axes[2], it.p.z, dr.fma(axes[1], it.p.y, dr.fma(axes[0], it.p.x, moved)))
        if self.poses.widths is None:
            ds, weight = self.sensor.sample_direction(seen_from, aperture, active)
        else:  # a pinhole's weight is d/(A z³), A the area of the image plane at distance 1, d and z those of the point
            distance, shrunk = dr.norm(seen_from.p), dr.rcp(dr.gather(mi.Float, self.poses.widths, self.image))
            seen_from.p = mi.Point3f(seen_from.p.x * shrunk, seen_from.p.y * shrunk, seen_from.p.z)
            ds, weight = self.sensor.sample_direction(seen_from, aperture, active)
            weight *= dr.square(shrunk) * distance * dr.rcp(ds.dist)
            ds.dist = distance
        *axes, origin = self._gather_columns(self.poses.to_world)
        ds.p, ds.n = origin + _turn_to_world(axes, ds.p), mi.Normal3f(_turn_to_world(axes, ds.n))
        ds.d = (ds.p - it.p) * dr.rcp(ds.dist)
        return ds, weight

    def _gather_columns(self, columns: list[mi.Vector3f]) -> list[mi.Vector3f]:
        """The columns of each lane's matrix."""
        return [dr.gather(mi.Vector3f, column, self.image) for column in columns]


def _turn_to_world(axes: list[mi.Vector3f], v: mi.Vector3f | mi.Point3f) -> mi.Vector3f:
    """A vector in the camera's frame, in the world."""
    return dr.fma(axes[2], v.z, dr.fma(axes[1], v.y, axes[0] * v.x))
