"""Points to pixels: the projection step between light transport and image synthesis [supplement 1.2].

Shape letters: B batch, P points, H W image, C channels, K points that land in an image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View
from photonfarm.trainer.runs.settings import Occlusion


@dataclass(frozen=True, slots=True)
class Optics:
    """The optics that all cameras of a scene share, and the rule by which hidden points are found."""

    focal_px: float
    width: int
    height: int
    near: float  # scene units, near plane of window depth
    far: float
    occlusion: Occlusion = "exact"
    tolerance: float = 1e-3  # ε of the rule on window depth [supplement 1.2]

    @classmethod
    def of(cls, spec: SceneSpec, occlusion: Occlusion = "exact", tolerance: float = 1e-3) -> Optics:
        """The optics of a spec; the focal length is that of every `Camera` of it."""
        camera = Camera.of(View(np.zeros(3, np.float32), np.ones(3, np.float32)), spec)
        return cls(camera.focal_px, camera.width, camera.height, spec.view.near, spec.view.far, occlusion, tolerance)

    def rays(self, world_to_camera: Tensor) -> Tensor:
        """Unit world directions through the pixel centres, (B, H, W, 3): normalise(T⁻¹ K⁻¹ (u+.5, v+.5, 1))."""
        x = (torch.arange(self.width).to(world_to_camera) + 0.5 - 0.5 * self.width) / self.focal_px
        y = (torch.arange(self.height).to(world_to_camera) + 0.5 - 0.5 * self.height) / self.focal_px
        right, down, forward = (world_to_camera[:, None, None, i, :3] for i in range(3))
        direction = x[:, None] * right + y[:, None, None] * down + forward
        return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The pixel of each point; one entry per kept point."""

    point: Tensor  # (K,) int64 index into B·P
    pixel: Tensor  # (K,) int64 index into B·H·W


@torch.no_grad()
def footprint(
    position: Tensor, present: Tensor, seen: Tensor, world_to_camera: Tensor, depth: Tensor, optics: Optics
) -> Footprint:
    """The kept points, and their pixels.

    position (B, P, 3) world, present and seen (B, P) bool, world_to_camera (B, 3, 4), depth (B, H, W) along the forward
    axis. Image coordinates are floored. Points are dropped if they are flagged as absent, behind the camera, outside
    the image, or occluded. By the rule "exact", points that are not `seen` are occluded, whatever the depth. By the
    rule "window" [supplement 1.2], points that lie behind the rendered depth by more than the tolerance, seen or not,
    and none where the depth is 0, as nothing was hit there.

    Window depth is OpenGL's, w(z) = (1/near − 1/z) / (1/near − 1/far), 0 at the near plane and 1 at the far plane. The
    supplement's ε = 1e-3 is only sensible there: on linear depth it removes points of slanted surfaces [method 2].
    """
    is_exact = optics.occlusion == "exact"
    x, y, z = (position @ world_to_camera[:, :, :3].mT + world_to_camera[:, None, :, 3]).unbind(-1)
    ahead = (present & seen if is_exact else present) & (z > 0)
    z = torch.where(ahead, z, 1)  # avoids division by zero; dropped below
    column = torch.floor(optics.focal_px * x / z + 0.5 * optics.width)
    row = torch.floor(optics.focal_px * y / z + 0.5 * optics.height)
    inside = ahead & (column >= 0) & (column < optics.width) & (row >= 0) & (row < optics.height)
    sample, point = inside.nonzero(as_tuple=True)
    u, v = column[sample, point].long(), row[sample, point].long()
    if not is_exact:
        surface = depth[sample, v, u]
        behind = (1 / surface - 1 / z[sample, point]) / (1 / optics.near - 1 / optics.far)
        in_sight = (surface == 0) | (behind <= optics.tolerance)
        sample, point, u, v = (index[in_sight] for index in (sample, point, u, v))
    return Footprint(point=sample * position.shape[1] + point, pixel=(sample * optics.height + v) * optics.width + u)


def project_mean(features: Tensor, kept: Footprint, height: int, width: int) -> Tensor:
    """The mean feature of the points in each pixel, zero where there is none: (B, P, C) → (B, H, W, C).

    Differentiable in the features; a point that is not in the footprint contributes nothing, in value or gradient.
    """
    B, _, C = features.shape
    pixels = B * height * width
    total = features.new_zeros(pixels, C).index_add(0, kept.pixel, features.flatten(0, 1).index_select(0, kept.point))
    count = torch.bincount(kept.pixel, minlength=pixels).clamp(min=1).to(features.dtype)
    return (total / count[:, None]).view(B, height, width, C)
