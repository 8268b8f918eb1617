"""The arrays that make up a scene and its samples, as they pass between renderer, store and trainer.

Shape letters: H W image, P points of the base cloud, L of them that are lit, K photon slots, V vertices, F faces,
S shapes, G movable groups.
Lengths are in scene units and world coordinates; radiance is linear RGB, scene-referred, never clipped.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

F32: TypeAlias = NDArray[np.float32]

LIT_POINTS = 1024
"""The number of points, the first of the base cloud, whose direct irradiance is stored among a view's guides.

A smaller cloud has all its points there.
"""

STATIC = -1
"""The group index of what never moves."""

NOTHING = -1
"""What an image of groups has where nothing is met; there 0 is what never moves, and g + 1 group g of the spec."""


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """The triangles of a scene at rest: stored once per scene."""

    vertices: F32  # (V, 3)
    faces: NDArray[np.uint32]  # (F, 3) vertex indices
    face_shape: NDArray[np.int32]  # (F,) shape index
    shape_group: NDArray[np.int16]  # (S,) movable group of each shape, or STATIC

    def areas(self) -> NDArray[np.float64]:
        """Area of each triangle, (F,)."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Pivots:
    """What the groups of a scene turn about: the axis `up` through each group's `at`."""

    at: NDArray[np.float64]  # (G, 3)
    up: NDArray[np.float64]  # (3,) unit, along one axis


@dataclass(frozen=True, slots=True, eq=False)
class BasePointCloud:
    """The point cloud sampled once per scene; every sample's cloud is this one, modified [supplement 2.1]."""

    position: F32  # (P, 3)
    normal: F32  # (P, 3) unit, geometric
    albedo: F32  # (P, 3) diffuse reflectance
    emission: F32  # (P, 3) radiance leaving along the normal
    group: NDArray[np.int16]  # (P,) movable group, or STATIC
    face: NDArray[np.uint32]  # (P,) triangle of `Geometry` that the point lies in
    pivots: Pivots | None = None  # of the spec, and not stored; None: a scene whose configurations have no turns


@dataclass(frozen=True, slots=True, eq=False)
class ViewBuffers:
    """The first hits of rays through each pixel, free of noise: of one through its centre, for albedo of a grid.

    Values are zero where the rays meet nothing.
    """

    depth: F32  # (H, W) along the camera's forward axis; hit point = origin + ray · depth / (ray · forward)
    albedo: F32  # (H, W, 3) diffuse reflectance, the mean over the pixel's area
    normal: F32  # (H, W, 3) unit, shading normal in world coordinates, as modelled (not turned to the camera)


@dataclass(frozen=True, slots=True, eq=False)
class Guides:
    """The guides of a view, which networks may be given: means over a grid of rays through each pixel.

    Pure mirrors, glass and null surfaces are followed, along their stronger lobe, to the first surface that scatters
    otherwise: `throughput` is the product of what they let through, and `beyond_*` describes that surface. All four are
    zero where a pixel's first surface scatters by itself. `direct`, `gloss` and `point_light` are noisy; they have
    seeds of their own, so that they are independent of the radiance of every sample. All are zero where a ray meets
    nothing, except the emission of environments.
    """

    emission: F32  # (H, W, 3) radiance emitted towards the eye, also by what is seen in mirrors and through glass
    direct: F32  # (H, W, 3) direct light reflected diffusely towards the eye, also in mirrors and through glass
    gloss: F32  # (H, W, 3) direct light reflected by all other lobes: the whole minus `direct`; it may be below 0
    specular: F32  # (H, W, 3) directional albedo of all lobes but the diffuse one, at least 0
    roughness: F32  # (H, W) microfacet α of the surface: 0 for mirrors and glass, 1 for diffuse surfaces
    mean_depth: F32  # (H, W) along the camera's forward axis
    mean_normal: F32  # (H, W, 3) shading normals turned to the eye, world; shorter than 1 where they differ
    throughput: F32  # (H, W, 3)
    beyond_albedo: F32  # (H, W, 3) diffuse reflectance
    beyond_normal: F32  # (H, W, 3) as `mean_normal`, turned to where the path comes from
    beyond_depth: F32  # (H, W) length of the path from the eye, scene units
    point_light: F32  # (L, 3) direct irradiance of the cloud's first points, on the normal's side


@dataclass(frozen=True, slots=True, eq=False)
class Photons:
    """Surface hits of light sub-paths in one configuration; empty slots have bounce −1 and zeros."""

    position: F32  # (K, 3)
    direction: F32  # (K, 3) unit, the way the light travels
    normal: F32  # (K, 3) unit, geometric
    power: F32  # (K, 3) RGB flux; the sum does not depend on the number emitted
    bounce: NDArray[np.int8]  # (K,) 0 for the first hit, −1 for an empty slot


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """Which of the scene's points a view sees: those in the image that nothing hides from the eye.

    A point is seen if its pixel, by floor, is one of the image's, it lies between the near and the far plane, and no
    surface meets the straight line to it, from where that line crosses the near plane to 1e-4 of the distance from the
    eye before the point. Glass and masks hide what is behind them, as they do in `ViewBuffers`.
    """

    points: NDArray[np.bool_]  # (P,) of the base cloud as it is modified; False for points of removed groups
    photons: NDArray[np.bool_]  # (K,) of the configuration; False for empty slots; (0,) for a scene without photons


def arrays_of(
    record: Geometry | BasePointCloud | ViewBuffers | Guides | Photons | Visibility,
) -> dict[str, NDArray[np.generic]]:
    """The record's arrays by name, in the order of its fields."""
    values = {field.name: getattr(record, field.name) for field in fields(record)}
    return {name: value for name, value in values.items() if name != "pivots"}
