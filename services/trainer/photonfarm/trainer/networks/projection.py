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
from photonfarm.trainer.runs.devices import is_asynchronous
from photonfarm.trainer.runs.settings import Occlusion


@dataclass(frozen=True, slots=True)
class Optics:
    """The optics that all cameras of a scene share, and the rule by which hidden points are found."""

    focal_px: float  # of views that have none of their own
    width: int
    height: int
    near: float  # scene units, near plane of window depth
    far: float
    occlusion: Occlusion = "exact"
    tolerance: float = 1e-3  # ε of the rule on window depth [supplement 1.2]

    @classmethod
    def of(cls, spec: SceneSpec, occlusion: Occlusion = "exact", tolerance: float = 1e-3) -> Optics:
        """The optics of a spec."""
        camera = Camera.of(View(np.zeros(3, np.float32), np.ones(3, np.float32)), spec)
        return cls(camera.focal_px, camera.width, camera.height, spec.view.near, spec.view.far, occlusion, tolerance)

    def focal(self, focal_px: Tensor | None, axes: int) -> Tensor | float:
        """The focal length to divide an array by, whose first axis is B and which has so many further ones.

        `focal_px` (B,) are those of the views; None: all have the scene's.
        """
        return self.focal_px if focal_px is None else focal_px.reshape(-1, *[1] * axes)

    def rays(self, world_to_camera: Tensor, focal_px: Tensor | None = None) -> Tensor:
        """Unit world directions through the pixel centres, (B, H, W, 3): normalise(T⁻¹ K⁻¹ (u+.5, v+.5, 1))."""
        columns, rows = (
            torch.arange(n, device=world_to_camera.device).to(world_to_camera) for n in (self.width, self.height)
        )
        x = (columns + 0.5 - 0.5 * self.width) / self.focal(focal_px, 1)
        y = (rows + 0.5 - 0.5 * self.height) / self.focal(focal_px, 1)
        right, down, forward = (world_to_camera[:, None, None, i, :3] for i in range(3))
        direction = x[..., None, :, None] * right + y[..., :, None, None] * down + forward
        return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The pixel of each kept point.

    On a processor there is one entry per kept point. A card would be waited for to learn how many these are: there it
    has all points, and those left out lie in any pixel and count nothing.
    """

    pixel: Tensor  # (K,) int64 index into B·H·W
    point: Tensor | None = None  # (K,) int64 index into B·P; None: all in their order
    left_out: Tensor | None = None  # (K,) bool; None: no entry is

    def sum(self, values: Tensor, pixels: int) -> Tensor:
        """The sum of the kept points' values in each of B·H·W `pixels`: (B, P, C) → (B·H·W, C)."""
        return values.new_zeros(pixels, values.shape[-1]).index_add(0, self.pixel, self._take(values.flatten(0, 1)))

    def count(self, pixels: int) -> Tensor:
        """The number of kept points in each of B·H·W `pixels`, (B·H·W, 1) float."""
        ones = torch.ones(len(self.pixel), 1, device=self.pixel.device)
        ones = ones if self.left_out is None else ones.masked_fill_(self.left_out[:, None], 0)
        return torch.zeros(pixels, 1, device=self.pixel.device).index_add(0, self.pixel, ones)

    def _take(self, values: Tensor) -> Tensor:
        values = values if self.point is None else values.index_select(0, self.point)
        return values if self.left_out is None else values.masked_fill(self.left_out[:, None], 0)


@torch.no_grad()
def footprint(
    position: Tensor,
    present: Tensor,
    seen: Tensor,
    world_to_camera: Tensor,
    depth: Tensor,
    optics: Optics,
    focal_px: Tensor | None = None,
) -> Footprint:
    """The kept points, and their pixels.

    position (B, P, 3) world, present and seen (B, P) bool, world_to_camera (B, 3, 4), depth (B, H, W) along the forward
    axis, focal_px (B,) as in `Inputs`. Image coordinates are floored. Points are dropped if they are flagged as absent,
    behind the camera, outside the image, or occluded. By the rule "exact", points that are not `seen` are occluded,
    whatever the depth. By the rule "window" [supplement 1.2], points that lie behind the rendered depth by more than
    the tolerance, seen or not, and none where the depth is 0, as nothing was hit there.

    Window depth is OpenGL's, w(z) = (1/near − 1/z) / (1/near − 1/far), 0 at the near plane and 1 at the far plane. The
    supplement's ε = 1e-3 is only sensible there: on linear depth it removes points of slanted surfaces [method 2].
    """
    is_exact = optics.occlusion == "exact"
    x, y, z = (position @ world_to_camera[:, :, :3].mT + world_to_camera[:, None, :, 3]).unbind(-1)
    ahead = (present & seen if is_exact else present) & (z > 0)
    z = z.masked_fill(~ahead, 1)  # avoids division by zero; dropped below
    focal = optics.focal(focal_px, 1)
    column = torch.floor(focal * x / z + 0.5 * optics.width)
    row = torch.floor(focal * y / z + 0.5 * optics.height)
    kept = ahead & (column >= 0) & (column < optics.width) & (row >= 0) & (row < optics.height)
    u, v = (each.masked_fill(~kept, 0).long() for each in (column, row))
    pixel = v * optics.width + u
    if not is_exact:
        surface = depth.flatten(1).gather(1, pixel)
        behind = (1 / surface - 1 / z) / (1 / optics.near - 1 / optics.far)
        kept &= (surface == 0) | (behind <= optics.tolerance)
    return _of_kept(kept, pixel, optics.height * optics.width)


def _of_kept(kept: Tensor, pixel: Tensor, pixels: int) -> Footprint:
    """The footprint of kept points (B, P), each in one of `pixels` of its image."""
    samples, points = kept.shape
    first = torch.arange(samples, device=kept.device)[:, None] * pixels
    if is_asynchronous(kept.device):
        anywhere = torch.arange(points, device=kept.device) % pixels  # sums are slow where all go to one pixel
        return Footprint((first + torch.where(kept, pixel, anywhere)).flatten(), left_out=~kept.flatten())
    point = kept.flatten().nonzero().flatten()
    return Footprint((first + pixel).flatten().index_select(0, point), point)


def project_mean(features: Tensor, kept: Footprint, height: int, width: int) -> Tensor:
    """The mean feature of the points in each pixel, zero where there is none: (B, P, C) → (B, H, W, C).

    Differentiable in the features; a point that is not in the footprint contributes nothing, in value or gradient.
    """
    pixels = len(features) * height * width
    mean = kept.sum(features, pixels) / kept.count(pixels).clamp(min=1).to(features.dtype)
    return mean.view(len(features), height, width, -1)
