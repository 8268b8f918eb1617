"""Light that lit points send on: instant radiosity from the scene's point cloud [Keller 1997]. Nothing is learned here.

Each of the first points of the cloud stands for its share of the scene's surface, and sends on what direct light brings
to it and it reflects. Every pixel sums that over all points, by the form factor cos θ cos θ′ A / (π r²): a sum that
depends on the receiver, which a maximum over points cannot be. Glossy surfaces sum it over the directions that their
lobe mirrors. Direct light has its shadows, as rendered; what stands between point and pixel is left to the U-Net.

Shape letters: B batch, L lit points, H W image, N receivers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, given

HALVED = 2
"""Diffuse surfaces receive at half the resolution: what comes from all around changes little from pixel to pixel."""

GLOSSY = 0.02
"""Directional albedo of lobes other than diffuse and followed ones, from which a pixel sums over a lobe."""

SHARPEST = 0.15
"""Least roughness of such a lobe: a narrower one would fall between points."""

CHANNELS = 6


class LitPoints(nn.Module):
    """The radiance of white diffuse surfaces, and of lobes over their albedo, by what lit points send on."""

    albedo: Tensor
    normal: Tensor

    def __init__(self, frame: SceneFrame, count: int) -> None:
        """Take the first `count` points of a frame's cloud, or as many as are lit."""
        super().__init__()
        self._optics = frame.optics
        self._count = min(count, len(frame.appearance))
        self._area = frame.area / self._count
        self.register_buffer("normal", torch.from_numpy(frame.appearance[: self._count, 0:3].copy()), persistent=False)
        self.register_buffer("albedo", torch.from_numpy(frame.appearance[: self._count, 3:6].copy()), persistent=False)

    @torch.no_grad()
    def forward(self, inputs: Inputs) -> list[Tensor]:
        """Light by diffuse reflection and by other lobes, (B, H, W, 3) each; the latter 0 where a surface has none."""
        images = [self._of_sample(inputs, place) for place in range(len(inputs.depth))]
        return [torch.stack(parts) for parts in zip(*images, strict=True)]

    def _of_sample(self, inputs: Inputs, place: int) -> tuple[Tensor, Tensor]:
        points, guides = given(inputs.points), given(inputs.guides)
        source, there = points.position[place, : self._count], points.visible[place, : self._count, None]
        sent = self.albedo * guides.point_light[place, : self._count] * there / math.pi
        rays, surface, normal = self._surfaces(inputs, place)
        diffuse = self._diffuse(surface, normal, source, sent)
        glossy = (guides.specular[place] - guides.throughput[place]).mean(-1) > GLOSSY
        gloss = torch.zeros_like(surface)
        if glossy.any():
            at = surface[glossy], normal[glossy], rays[glossy], guides.roughness[place][glossy]
            gloss[glossy] = self._lobes(*at, source, sent)
        return diffuse, gloss

    def _surfaces(self, inputs: Inputs, place: int) -> tuple[Tensor, Tensor, Tensor]:
        """Ray, position and normal of what each pixel sees, (H, W, 3) each."""
        guides, to_camera = given(inputs.guides), inputs.world_to_camera[place]
        rays = self._optics.rays(to_camera[None])[0]
        eye = -to_camera[:, :3].T @ to_camera[:, 3]
        distance = guides.mean_depth[place] / (rays @ to_camera[2, :3])
        return rays, eye + rays * distance[..., None], functional.normalize(guides.mean_normal[place], dim=-1)

    def _diffuse(self, surface: Tensor, normal: Tensor, source: Tensor, sent: Tensor) -> Tensor:
        """Σ over points of what they send × form factor, (H, W, 3)."""
        height, width = surface.shape[:2]
        at, facing = (_pooled(image).reshape(-1, 3) for image in (surface, normal))
        facing = functional.normalize(facing, dim=-1)
        leaves, squared = self._between(at, source)
        cosines = (facing @ source.T - (facing * at).sum(-1, keepdim=True)).clamp(min=0) * leaves
        found = (cosines / (squared * squared)) @ (sent * (self._area / math.pi))
        coarse = found.reshape(1, height // HALVED, width // HALVED, 3).permute(0, 3, 1, 2)
        return functional.interpolate(coarse, scale_factor=HALVED, mode="bilinear")[0].permute(1, 2, 0)

    def _lobes(
        self, at: Tensor, normal: Tensor, rays: Tensor, roughness: Tensor, source: Tensor, sent: Tensor
    ) -> Tensor:
        """The mean of what points send over a lobe about the mirrored ray, (N, 3).

        By a von Mises–Fisher lobe of κ = 2 / α², over the solid angle that each point stands for.
        """
        mirrored = rays - 2 * (rays * normal).sum(-1, keepdim=True) * normal
        leaves, squared = self._between(at, source)
        distance = squared.sqrt()
        cosine = (mirrored @ source.T - (mirrored * at).sum(-1, keepdim=True)) / distance
        sharpness = 2 / roughness.clamp(min=SHARPEST)[:, None] ** 2
        weight = torch.exp(sharpness * (cosine - 1)) * leaves / (squared * distance)
        return (weight @ sent) / weight.sum(-1, keepdim=True).clamp(min=1e-12)

    def _between(self, at: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """Distance × cosine at each point's front, at least 0, and the squared distance, (N, L) each.

        The square is not below a point's area over π, so that no near point outweighs all others.
        """
        leaves = (at @ self.normal.T - (source * self.normal).sum(-1)).clamp(min=0)
        squared = (at * at).sum(-1, keepdim=True) + (source * source).sum(-1) - 2 * at @ source.T
        return leaves, squared.clamp(min=self._area / math.pi)


def _pooled(image: Tensor) -> Tensor:
    """Means over squares of pixels, (H, W, 3) → (H/2, W/2, 3)."""
    return functional.avg_pool2d(image.permute(2, 0, 1)[None], HALVED)[0].permute(1, 2, 0)
