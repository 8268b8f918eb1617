"""Networks that are told what is known of a view: the image is that, and what is learned is the rest. All ours.

    image = emission + known light + reflectance × U-Net

Emission and direct light are rendered [renderer.guides], and photons bring the light that was reflected before; what
the U-Net adds is divided by how much a surface reflects, so that it has neither textures nor the colours of metals to
learn. Nothing here has seen the noise of the half-estimates that it is compared with.

Shape letters: B batch, P points, H W image, C channels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import GuideInputs, Inputs, given
from photonfarm.trainer.networks.lit_points import CHANNELS, LitPoints
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.photon_light import PhotonLight
from photonfarm.trainer.photon_map import WINDOWS
from photonfarm.trainer.settings import NetworkSettings

GUIDE_CHANNELS = 27
"""Beside view ray 3, depth 1, albedo 3 and normal 3: emission, direct light, gloss, specular, mean normal, throughput,
and albedo and normal beyond, 3 each; roughness, mean depth and depth beyond, 1 each."""

REFLECTANCE_FLOOR = 0.2
"""Least factor of what the U-Net says: what is known of a surface may be wrong, and blends and edges reflect more."""


def reflectance(albedo: Tensor, guides: GuideInputs) -> Tensor:
    """How much of the light a pixel shows, (B, H, W, 3): of the surface, or of the one that mirrors and glass show."""
    own = albedo + (guides.specular - guides.throughput).clamp(min=0)
    return own + guides.throughput * guides.beyond_albedo


class Guided(Network):
    """Image synthesis from the guides of a view, added to its emission and direct light."""

    def __init__(self, settings: NetworkSettings, frame: SceneFrame, *, further: int = 0) -> None:
        super().__init__(settings, frame, further=further + GUIDE_CHANNELS)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure."""
        guides = given(inputs.guides)
        scale = reflectance(inputs.albedo, guides) + REFLECTANCE_FLOOR
        further = self.further(inputs)
        channels = torch.cat([*further, *self.guide_channels(guides, scale), self.image_space(inputs)], dim=-1)
        return self.known(inputs, further) + scale * self.synthesise(channels)

    def guide_channels(self, guides: GuideInputs, scale: Tensor) -> list[Tensor]:
        """The guides near 1, each (B, H, W, C): light as log(1 + it), direct light over what reflects it."""
        return [
            torch.log1p(guides.emission),
            torch.log1p(guides.direct / scale),
            guides.gloss.sign() * torch.log1p(guides.gloss.abs() / scale),
            guides.specular,
            guides.mean_normal,
            guides.throughput,
            guides.beyond_albedo,
            guides.beyond_normal,
            guides.roughness[..., None],
            guides.mean_depth[..., None] / self.scale,
            guides.beyond_depth[..., None] / self.scale,
        ]

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:  # noqa: ARG002 - what other kinds see
        """Emission and reflected direct light, (B, H, W, 3)."""
        guides = given(inputs.guides)
        return guides.emission + guides.direct + guides.gloss


class GuidedTransport(Guided):
    """The same, with what lit points send on to each pixel, by diffuse reflection and by other lobes."""

    def __init__(self, settings: NetworkSettings, frame: SceneFrame, *, further: int = 0) -> None:
        super().__init__(settings, frame, further=further + CHANNELS)
        self.lit_points = LitPoints(frame, settings.lit_points)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """log(1 + light), (B, H, W, 3) each."""
        return [torch.log1p(light) for light in self.lit_points(inputs)]


class GuidedPhotons(Guided):
    """`Guided` with what photons that were reflected before bring to diffuse surfaces, seen and added."""

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        photon_light = PhotonLight(frame, settings.architecture, bounces=1)
        super().__init__(settings, frame, further=3 * len(WINDOWS))
        self.photon_light = photon_light

    def further(self, inputs: Inputs) -> list[Tensor]:
        """log(1 + what is gathered) by each window, (B, H, W, 3)."""
        return [torch.log1p(radiance) for radiance in self.photon_light(inputs)]

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """Emission, direct light, and albedo times what the widest window has gathered, (B, H, W, 3)."""
        return super().known(inputs, further) + inputs.albedo * torch.expm1(further[-1])


class GuidedTransportPhotons(GuidedTransport):
    """Both: what lit points send on, and photons, seen and added."""

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        photon_light = PhotonLight(frame, settings.architecture, bounces=1)
        super().__init__(settings, frame, further=3 * len(WINDOWS))
        self.photon_light = photon_light

    def further(self, inputs: Inputs) -> list[Tensor]:
        """log(1 + light), (B, H, W, 3) each: of lit points, then of photons by each window."""
        return [*super().further(inputs), *(torch.log1p(radiance) for radiance in self.photon_light(inputs))]

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """Emission, direct light, and albedo times what the widest window has gathered, (B, H, W, 3)."""
        return super().known(inputs, further) + inputs.albedo * torch.expm1(further[-1])
