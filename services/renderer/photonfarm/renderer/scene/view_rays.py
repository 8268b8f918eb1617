"""The cameras of several views, whose rays are made in the kernel that traces them, and sums over a pixel's rays there.

A kernel has one lane for each pixel, view after view. What it finds leaves the device as images.

Shape letters: K views, H W image, N = K·H·W lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.records import F32
from photonfarm.renderer.bdpt.recording import loop_once
from photonfarm.renderer.scene.arrays import floats
from photonfarm.scene.spec import RAYS_PER_PIXEL, SceneSpec
from photonfarm.scene.view import Camera, View

GRID = math.isqrt(RAYS_PER_PIXEL)
"""The number of rays along each axis of a pixel, over which albedo and guides are averaged."""

NUMBERS = 13
"""The numbers of a camera: origin, right, down, forward, focal length in pixels."""

Columns = dict[str, Any]
"""Quantities of each lane by name, Float or Color3f."""


@dataclass(slots=True)
class ViewCameras:
    """The cameras of K views of one film, as a kernel's data.

    A kernel that is recorded needs an input of one number that it does not gather: from that alone `dr.freeze` infers
    the number of lanes correctly. It would take the length of the largest array of the scene for it. `near` is one.
    """

    numbers: Any  # Float [K · NUMBERS]
    near: Any  # Float [1]: the distance of the near plane
    far: Any  # Float [1]: that of the far plane
    views: int
    width: int
    height: int

    @classmethod
    def of(cls, views: Sequence[View], spec: SceneSpec) -> Self:
        """The cameras of views through the spec's film."""
        cameras = [Camera.of(view, spec) for view in views]
        numbers = [[*c.origin, *c.right, *c.down, *c.forward, c.focal_px] for c in cameras]
        near, far = (dr.opaque(mi.Float, distance) for distance in (spec.view.near, spec.view.far))
        return cls(floats(np.array(numbers)), near, far, len(views), spec.film.width, spec.film.height)

    @property
    def kind(self) -> tuple[int, ...]:
        """The numbers that kernels are made for."""
        return self.views, self.width, self.height

    @property
    def lanes(self) -> int:
        """The number of pixels of all views."""
        return self.views * self.height * self.width

    def pixels(self) -> Pixels:
        """The pixel of each lane, view after view."""
        lane = dr.arange(mi.UInt32, self.lanes)
        row, column = lane // self.width, lane % self.width
        view = row // self.height
        return Pixels(self.of_views(view), mi.Float(column), mi.Float(row - view * self.height))

    def of_views(self, view: Any) -> Looks:
        """The camera of the view of each lane, by its number."""
        number = [dr.gather(mi.Float, self.numbers, view * NUMBERS + i) for i in range(NUMBERS)]
        origin, right, down, forward = (mi.Vector3f(*number[i : i + 3]) for i in (0, 3, 6, 9))
        return Looks(origin, right, down, forward, number[12], self.near, self.far, self.width, self.height)


@dataclass(slots=True)
class Looks:
    """The camera of each lane."""

    origin: Any  # Vector3f
    right: Any  # Vector3f
    down: Any  # Vector3f
    forward: Any  # Vector3f
    focal_px: Any  # Float
    near: Any  # Float
    far: Any  # Float
    width: int
    height: int


@dataclass(slots=True)
class Pixels:
    """The pixel of each lane."""

    looks: Looks
    column: Any  # Float
    row: Any  # Float

    def ray(self, u: Any, v: Any) -> PixelRay:
        """The rays through a place within the pixels, 0.5 their centres, from the near to the far plane."""
        looks = self.looks
        x, y = self.column + (u - 0.5 * looks.width), self.row + (v - 0.5 * looks.height)
        d = dr.normalize((x / looks.focal_px) * looks.right + (y / looks.focal_px) * looks.down + looks.forward)
        along = dr.dot(d, looks.forward)
        before = looks.near / along
        ray = mi.Ray3f(mi.Point3f(looks.origin + d * before), d, looks.far / along - before, 0, [])
        return PixelRay(ray, along, before, looks.near)


@dataclass(slots=True)
class PixelRay:
    """One ray for each pixel, that begins on the near plane."""

    ray: Any  # Ray3f, whose `maxt` is at the far plane
    along: Any  # Float: its cosine to the forward axis
    before: Any  # Float: its distance from the eye
    near: Any  # Float

    def depth(self, distance: Any) -> Any:
        """The distance along the forward axis of what the ray meets so far from its origin."""
        return self.near + distance * self.along


def sum_over_grid(
    cameras: ViewCameras, channels: Mapping[str, int], columns_of: Callable[[PixelRay, Any], Columns]
) -> Columns:
    """The sums over the rays of each pixel's grid, row by row, of columns with so many channels, 3 or 1.

    `columns_of` takes the rays and their number within the pixel, a UInt32.
    """
    pixels, kinds = cameras.pixels(), {name: mi.Color3f if count == 3 else mi.Float for name, count in channels.items()}

    def add(index: Any, sums: Columns) -> tuple[Any, Columns]:
        row = index // GRID
        u, v = ((mi.Float(place) + 0.5) / GRID for place in (index - row * GRID, row))
        columns = columns_of(pixels.ray(u, v), index)
        return index + 1, {name: total + kinds[name](columns[name]) for name, total in sums.items()}

    start = {name: dr.zeros(kind, cameras.lanes) for name, kind in kinds.items()}
    _, sums = loop_once(
        state=(dr.zeros(mi.UInt32, cameras.lanes), start),
        cond=lambda index, _: index < RAYS_PER_PIXEL,
        body=add,
        labels=("index", "sums"),
        label="rays of a pixel",
    )
    return sums


def interleave(columns: Columns, channels: Mapping[str, int], lanes: int) -> Columns:
    """The columns as Float arrays in which each lane's channels lie together, as in images; one kernel makes all."""
    lane, arrays = dr.arange(mi.UInt32, lanes), {name: columns[name] for name in channels}
    for name, count in channels.items():
        if count == 3:
            arrays[name] = dr.zeros(mi.Float, lanes * count)
            dr.scatter(arrays[name], columns[name], lane)
    dr.eval(arrays)
    return arrays


def take_numpy(values: Any) -> F32:
    """Values of Dr.Jit as an array of numpy, in memory of its own.

    In Dr.Jit's memory it would have to be freed by the thread that renders: another one that frees it, such as the one
    that writes samples, waits at full speed until all kernels under way have ended.
    """
    return np.array(values, np.float32)


Take = Callable[[Any], Any]
"""A function that takes values out of Dr.Jit: `take_numpy`, or one that leaves them on the device."""


def shape_images(
    arrays: Columns, channels: Mapping[str, int], cameras: ViewCameras, take: Take
) -> list[dict[str, Any]]:
    """The images of each view by name, (H, W, 3) or (H, W), from what `interleave` returned."""
    shape = cameras.views, cameras.height, cameras.width
    images = {name: take(arrays[name]).reshape(*shape, *[count][: count - 1]) for name, count in channels.items()}
    return [{name: image[k] for name, image in images.items()} for k in range(cameras.views)]
