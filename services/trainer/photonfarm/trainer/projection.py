"""Points to pixels: the projection step between light transport and image synthesis [supplement 1.2].

Shape letters: B batch, P points, H W image, C channels, K points that land in an image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.view import Camera, View
from photonfarm.trainer.settings import DepthSpace


@dataclass(frozen=True, slots=True)
class Optics:
    """What all cameras of a scene have in common, and how the occlusion check measures depth."""

    focal_px: float
    width: int
    height: int
    near: float  # scene units, near plane of window depth
    far: float
    depth_space: DepthSpace = "window"
    tolerance: float = 1e-3  # ε [supplement 1.2]

    @classmethod
    def of(cls, spec: SceneSpec, depth_space: DepthSpace = "window", tolerance: float = 1e-3) -> Optics:
        """The optics of a spec; the focal length is that of every `Camera` of it."""
        camera = Camera.of(View(np.zeros(3, np.float32), np.ones(3, np.float32)), spec)
        return cls(camera.focal_px, camera.width, camera.height, spec.view.near, spec.view.far, depth_space, tolerance)

    def rays(self, world_to_camera: Tensor) -> Tensor:
        """Unit world directions through the pixel centres, (B, H, W, 3): normalise(T⁻¹ K⁻¹ (u+.5, v+.5, 1))."""
        x = (torch.arange(self.width).to(world_to_camera) + 0.5 - 0.5 * self.width) / self.focal_px
        y = (torch.arange(self.height).to(world_to_camera) + 0.5 - 0.5 * self.height) / self.focal_px
        right, down, forward = (world_to_camera[:, None, None, i, :3] for i in range(3))
        direction = x[:, None] * right + y[:, None, None] * down + forward
        return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """Which point lands in which pixel; one entry per point that is seen."""

    point: Tensor  # (K,) int64 index into B·P
    pixel: Tensor  # (K,) int64 index into B·H·W


@torch.no_grad()
def footprint(position: Tensor, visible: Tensor, world_to_camera: Tensor, depth: Tensor, optics: Optics) -> Footprint:
    """The points that are seen, and their pixels.

    position (B, P, 3) world, visible (B, P) bool, world_to_camera (B, 3, 4), depth (B, H, W) along the forward axis.
    Image coordinates are floored. Dropped: points flagged invisible, behind the camera, off the image, or behind the
    rendered depth by more than the tolerance. Where the depth is 0 nothing was hit, and nothing is occluded.
    """
    x, y, z = (position @ world_to_camera[:, :, :3].mT + world_to_camera[:, None, :, 3]).unbind(-1)
    ahead = visible & (z > 0)
    z = torch.where(ahead, z, 1)  # divides safely; dropped below
    column = torch.floor(optics.focal_px * x / z + 0.5 * optics.width)
    row = torch.floor(optics.focal_px * y / z + 0.5 * optics.height)
    inside = ahead & (column >= 0) & (column < optics.width) & (row >= 0) & (row < optics.height)

    sample, point = inside.nonzero(as_tuple=True)
    u, v = column[sample, point].long(), row[sample, point].long()
    seen = ~_occluded(z[sample, point], depth[sample, v, u], optics)
    sample, point, u, v = sample[seen], point[seen], u[seen], v[seen]
    return Footprint(point=sample * position.shape[1] + point, pixel=(sample * optics.height + v) * optics.width + u)


def _occluded(z: Tensor, surface: Tensor, optics: Optics) -> Tensor:
    """True where a point at depth z lies behind the rendered surface by more than ε.

    Window depth is OpenGL's, w(z) = (1/near − 1/z) / (1/near − 1/far), 0 at the near plane and 1 at the far plane. The
    supplement's ε = 1e-3 is only sensible there: on linear depth it removes points of slanted surfaces [method 2].
    """
    hit = surface > 0
    surface = torch.where(hit, surface, 1)
    match optics.depth_space:
        case "window":
            behind = (1 / surface - 1 / z) / (1 / optics.near - 1 / optics.far)
        case "linear":
            behind = z - surface
        case "relative":
            behind = z / surface - 1
    return hit & (behind > optics.tolerance)


def project_mean(features: Tensor, seen: Footprint, height: int, width: int) -> Tensor:
    """The mean feature of the points in each pixel, zero where there is none: (B, P, C) → (B, H, W, C).

    Differentiable in the features; a point that is not in the footprint contributes nothing, in value or gradient.
    """
    B, _, C = features.shape
    pixels = B * height * width
    total = features.new_zeros(pixels, C).index_add(0, seen.pixel, features.flatten(0, 1).index_select(0, seen.point))
    count = torch.bincount(seen.pixel, minlength=pixels).clamp(min=1).to(features.dtype)
    return (total / count[:, None]).view(B, height, width, C)
