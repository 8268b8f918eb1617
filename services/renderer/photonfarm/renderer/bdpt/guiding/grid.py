"""Where guides are learned: a grid over a scene, the lanes of launches, and the start squares of lights.

*The grid* is a coarse one over a scene's bounding box, whose cells number points of space. *Lanes*: a guide is learned
by fewer eye paths than pixels. *Start squares*, [0, 1)² each: a light path starts at a point of two of them. The
*square of directions* is the one that is always guided:
    area lights       the direction about the surface's normal, by Shirley and Chiu's map and Malley's method
    lights at infinity  where the ray enters the disk across the scene's sphere
    point lights      the direction, uniform in the cone about the light's axis
The *square of positions* is guided for rectangles alone, whose texture coordinates it is. The point of a square is
found again from a light path.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.launches import Lanes

_MARGIN = 0.01373, 0.02291  # below and above the scene, over its extent: so that walls seldom lie between two cells


@dataclass(slots=True)
class Grid:
    """A grid of side³ cells, as data: a scene of another size recompiles nothing."""

    side: int
    lower: mi.Point3f  # [1]: its corner
    size: mi.Vector3f  # [1]: of a cell

    @classmethod
    def over(cls, box: mi.ScalarBoundingBox3f, side: int) -> Grid:
        """The grid over a bounding box."""
        low, extent = box.min, box.extents()
        lower = mi.Point3f(*(dr.opaque(mi.Float, float(low[k] - _MARGIN[0] * extent[k])) for k in range(3)))
        share = (1 + sum(_MARGIN)) / side
        size = mi.Vector3f(*(dr.opaque(mi.Float, max(float(extent[k]) * share, 1e-6)) for k in range(3)))
        return cls(side, lower, size)

    def place(self, p: mi.Point3f) -> mi.Vector3u:
        """The (x, y, z) of the cell that points lie in or are next to; some cell for points that are not finite.

        The last minimum sees to that: NaN converts to what the processor likes, with AVX2 far outside the grid.
        """
        place = dr.clip((p - self.lower) * dr.rcp(self.size), 0, self.side - 0.5)
        return dr.minimum(mi.Vector3u(place), self.side - 1)

    def cell(self, p: mi.Point3f) -> mi.UInt32:
        """The number of that cell, (z·side + y)·side + x."""
        x, y, z = self.place(p)
        return (z * self.side + y) * self.side + x


@dataclass(slots=True)
class SparseLanes(Lanes):
    """Lanes of which only some pixels of each image have an eye path, spread evenly over the image."""

    eyes: int = 1  # eye paths of one image

    @property
    def kind(self) -> tuple[int | bool, ...]:
        """The numbers that the kernels are made for."""
        return self.images, self.width, self.height, self.eyes, self.light_paths, self.poses is not None

    def thin(self, eyes: int) -> None:
        """Have so many eye paths in each image, at most one for each pixel."""
        self.eyes = min(eyes, self.pixels)
        self.eye_scale = dr.opaque(mi.Float, self.pixels / self.eyes)

    def eye(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """(image, sample, pixel) of each eye path's lane: a random pixel of an equal share of them."""
        lane = dr.arange(mi.UInt32, self.images * self.eyes)
        image = lane // self.eyes
        k = lane - image * self.eyes
        sequence = randomness.stream(dr.gather(mi.UInt32, self.keys, image), randomness.PIXELS)
        u = randomness.sampler(sequence, k).next_independent()
        pixel = mi.UInt32((mi.Float64(k) + mi.Float64(u)) * (self.pixels / self.eyes))
        return image, dr.zeros(mi.UInt32, dr.width(lane)), dr.minimum(pixel, self.pixels - 1)


_AXIS = 0.4343, 0.5772, 0.69154  # of length 1, along no direction that a scene's author would write down
_NEAR_AXIS = 1e-4  # the squared sine of the angle to the axis below which another one is taken


def frame_about(n: mi.Vector3f) -> mi.Frame3f:
    """A frame about unit vectors that depends on them continuously, except about ±`_AXIS`.

    Mitsuba's own frame turns by half a circle where n.z changes sign, as rounding does at the walls of most scenes.
    """
    s = dr.cross(mi.Vector3f(*_AXIS), n)
    s = dr.normalize(dr.select(dr.squared_norm(s) > _NEAR_AXIS, s, dr.cross(mi.Vector3f(1, 0, 0), n)))
    return mi.Frame3f(s, dr.cross(n, s), n)


def map_area_to_square(n: mi.Vector3f, d: mi.Vector3f) -> mi.Point2f:
    """The point of a square for light that leaves a surface of normal ``n`` along ``d``."""
    local = frame_about(n).to_local(d)
    return mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))


def map_disk_to_square(d: mi.Vector3f, offset: mi.Vector3f) -> mi.Point2f:
    """The point of a square for light from infinity along ``d``, which passes ``offset``.

    The offset is from the centre of the scene's sphere, and its unit is the radius.
    """
    local = frame_about(-d).to_local(offset)
    return mi.warp.uniform_disk_to_square_concentric(mi.Point2f(local.x, local.y))


def map_cone_to_square(axis: mi.Vector3f, cos_cutoff: mi.Float, d: mi.Vector3f) -> mi.Point2f:
    """The point of a square for light along ``d`` in a cone about ``axis``."""
    local = mi.Frame3f(axis).to_local(d)
    turn = dr.atan2(local.y, local.x) * dr.inv_two_pi
    return mi.Point2f((1 - local.z) / (1 - cos_cutoff), turn - dr.floor(turn))


# ------------------------------------------------ Cells of a square ------------------------------------------------


def cell_of(u: mi.Point2f, side: int) -> mi.UInt32:
    """The number along Morton's curve of the cell that points lie in, of ``side``² ones; some cell for NaN."""
    x, y = (mi.UInt32(dr.clip(u[k] * side, 0, side - 0.5)) for k in range(2))
    return dr.minimum(_spread(x) | (_spread(y) << 1), side * side - 1)


def _spread(x: mi.UInt32) -> mi.UInt32:
    """The lowest 16 bits, moved to even places."""
    for shift, bits in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | (x << shift)) & bits
    return x
