"""The photon map in image space: the irradiance of each pixel's surface, estimated from the photons.

The irradiance of a surface is the flux of the photons that land near over the area on which they do [Jensen, Global
Illumination using Photon Maps, 1996]; near means here near in the image. Noise falls with the number of photons and of
pixels, while differences between the pixels are blurred.
Shape letters: B batch, K photon slots, H W image.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.trainer.networks.inputs import Inputs, SceneFrame, require
from photonfarm.trainer.networks.projection import Footprint, Optics, footprint


class PhotonLight:
    """The exposed radiance of white diffuse surfaces by the photons in windows of the image.

    It takes the photons whose path to the eye is no longer than the paths of the images, and whose light has been
    reflected at least `bounces` times.
    """

    def __init__(self, frame: SceneFrame, architecture: str, *, bounces: int = 0) -> None:
        """Take the scene's constants from a frame; raises SpecError for a scene without photons."""
        if not frame.photon_paths:
            raise SpecError(
                f"network.architecture = {architecture!r}: the scene has photons.paths = 0, and none are stored; set "
                "photons.paths in its spec and render it anew, or train an architecture without photons"
            )
        self._optics, self._exposure, self._first = frame.optics, frame.exposure, bounces
        self._last = frame.max_depth - 2 if frame.max_depth >= 0 else math.inf  # then one edge to the eye

    def __call__(self, inputs: Inputs) -> list[Tensor]:
        """(B, H, W, 3) for each of `photon_map.WINDOWS`."""
        photons, view, own = require(inputs.photons), (inputs.world_to_camera, inputs.depth), inputs.focal_px
        on_side = arrives_on_seen_side(photons.position, photons.direction, photons.normal, inputs.world_to_camera)
        wanted = photons.present & on_side & (photons.bounce >= self._first) & (photons.bounce <= self._last)
        kept = footprint(photons.position, wanted, photons.seen, *view, self._optics, own)
        return gather_light(photons.power * self._exposure, kept, seen_area(self._optics, *view, inputs.normal, own))


WINDOWS = (0.07, 0.17)
"""The sides of the squares over which photons and area are summed, as shares of the image's width.

They are summed three times in a row, as a sum over one square has an edge. The wider window has less noise, the
narrower one more detail.
"""

GRAZING = 0.05
"""The cosine between ray and normal below which a pixel is left out: the area of surfaces seen edge-on is unbounded."""


def seen_area(
    optics: Optics, world_to_camera: Tensor, depth: Tensor, normal: Tensor, focal_px: Tensor | None = None
) -> Tensor:
    """The area of each pixel's surface, (B, H, W) in scene units²; 0 if there is none, or it is seen almost edge-on.

    z² / (f² |n · d|) for depth z, focal length f in pixels, unit shading normal n, and d the ray that crosses depth 1.
    """
    rays, forward = optics.rays(world_to_camera, focal_px), world_to_camera[:, None, None, 2, :3]
    along, facing = (rays * forward).sum(dim=-1), (rays * normal).sum(dim=-1).abs()
    area = (depth / optics.focal(focal_px, 2)) ** 2 * along / facing.clamp(min=GRAZING)
    return area.masked_fill(facing < GRAZING, 0)


def arrives_on_seen_side(position: Tensor, direction: Tensor, normal: Tensor, world_to_camera: Tensor) -> Tensor:
    """Whether photons (B, K, 3) arrive on the side of their surface that faces the eye, (B, K)."""
    eye = -(world_to_camera[:, :, :3].mT @ world_to_camera[:, :, 3:]).mT
    return (direction * normal).sum(dim=-1) * ((position - eye) * normal).sum(dim=-1) > 0


def gather_light(power: Tensor, kept: Footprint, area: Tensor) -> list[Tensor]:
    """Irradiance / π in each of `WINDOWS`, (B, H, W, 3): the radiance of white diffuse surfaces.

    power (B, K, 3) is flux over the number of paths emitted, area (B, H, W), and pixels where that is 0 are left out.
    The result is zero if there is no surface nearby.
    """
    B, H, W = area.shape
    flux = kept.sum(power, B * H * W).view(B, H, W, 3) * (area > 0)[..., None]
    both = torch.cat([flux, area[..., None]], dim=-1).permute(0, 3, 1, 2)
    maps = []
    for share in WINDOWS:
        beside = max(round(0.5 * (share * W - 1)), 1)
        across, down = (_make_blur(size, beside, both.dtype, both.device) for size in (W, H))
        around = (down @ (both @ across)).permute(0, 2, 3, 1)
        seen = around[..., 3:]
        maps.append(around[..., :3] / seen.masked_fill(~(seen > 0), math.inf) / math.pi)
    return maps


@cache
def _make_blur(size: int, beside: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The matrix (size, size) of means over so many places on each side, taken three times; zero outside."""
    place = torch.arange(size, dtype=torch.float64)
    near = ((place[:, None] - place).abs() <= beside).double() / (2 * beside + 1)
    return torch.linalg.matrix_power(near, 3).to(device, dtype)
