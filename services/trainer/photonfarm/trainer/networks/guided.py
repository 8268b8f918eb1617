"""Networks with guides: the image is what the guides give, and the rest is learned. All ours.

image = emission + known light + reflectance × U-Net

Emission and direct light are rendered [renderer.scene.guides]; lit points and photons add light that was reflected
before. The output of the U-Net is divided by the reflectance of a surface, so that it need learn neither textures nor
the colours of metals. No input depends on the noise of the half-estimates that are its targets.

Shape letters: B batch, H W image, C channels.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from photonfarm.trainer.networks.inputs import GuideInputs, Inputs, SceneFrame, reflectance, require
from photonfarm.trainer.networks.light_filter import estimate_variance, filter_light
from photonfarm.trainer.networks.lit_points import CHANNELS, DIFFUSE, LitPoints
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.photon_map import WINDOWS, PhotonLight
from photonfarm.trainer.runs.settings import NetworkSettings

GUIDE_CHANNELS = 27
"""The channels beside view ray 3, depth 1, albedo 3 and normal 3.

They are emission, direct light, gloss, specular, mean normal, throughput, and albedo and normal beyond, 3 each;
roughness, mean depth and depth beyond, 1 each.
"""

REFLECTANCE_FLOOR = 0.2
"""The least factor of the U-Net's output on surfaces that reflect: guides may be wrong, and blends reflect more."""

BLACK = 0.05
"""The reflectance below which that floor falls, to 0 for what reflects nothing, such as lamps, and windows at night."""


LIGHT = 3
"""The outputs of the U-Net that are light."""

SHARES_OF_DIRECT = (0.0, 1.0, -1.0)
"""The logits of direct light before anything is learned: as it is, filtered finely, coarsely."""


def floor(albedo: Tensor, guides: GuideInputs) -> Tensor:
    """The least factor of the U-Net's output, (B, H, W, 1): 0 where nothing reflects or is seen through."""
    anything = (albedo + guides.specular + guides.throughput).amax(dim=-1, keepdim=True)
    return REFLECTANCE_FLOOR * (anything / BLACK).clamp(max=1)


def guide_channels(inputs: Inputs, scale: float) -> list[Tensor]:
    """The guides as values near 1, each (B, H, W, C): light as log(1 + light), direct light over reflectance.

    Depths are divided by `scale`.
    """
    guides = require(inputs.guides)
    reflects = reflectance(inputs.albedo, guides) + REFLECTANCE_FLOOR
    return [
        torch.log1p(guides.emission),
        torch.log1p(guides.direct / reflects),
        guides.gloss.sign() * torch.log1p(guides.gloss.abs() / reflects),
        guides.specular,
        guides.mean_normal,
        guides.throughput,
        guides.beyond_albedo,
        guides.beyond_normal,
        guides.roughness[..., None],
        guides.mean_depth[..., None] / scale,
        guides.beyond_depth[..., None] / scale,
    ]


def show_known_light(inputs: Inputs) -> Tensor:
    """What a view emits, and the direct light that its surfaces reflect, as the guides give them, (B, H, W, 3)."""
    guides = require(inputs.guides)
    return guides.emission + guides.direct + guides.gloss


class Guided(Network):
    """Image synthesis from the guides of a view, added to its emission and direct light.

    If the settings say so, direct light is also given filtered, and added to the image by learned shares of each pixel.

    With `transport`, a kind of lit points, its inputs include the light that these send on to each pixel, by diffuse
    reflection and by other lobes, and the diffuse part is added to the image. With `photons` they include the light
    that photons, reflected before, bring to diffuse surfaces, which is added if lit points are not.
    """

    shares_of_direct: Tensor

    def __init__(
        self,
        settings: NetworkSettings,
        frame: SceneFrame,
        *,
        transport: type[LitPoints] | None = None,
        photons: bool = False,
        further: int = 0,
        outputs: int = LIGHT,
    ) -> None:
        """Take `further` channels of a kind of guided network beside those of transport, photons and guides.

        Its `outputs` begin with light; the shares of filtered direct light follow them.
        """
        photon_light = PhotonLight(frame, settings.architecture, bounces=1) if photons else None
        further += (CHANNELS if transport else 0) + (3 * len(WINDOWS) if photons else 0)
        self.filters_direct = settings.filter_direct
        if self.filters_direct:
            further, outputs = further + 2 * LIGHT, outputs + len(SHARES_OF_DIRECT)
        super().__init__(settings, frame, further=further + GUIDE_CHANNELS, outputs=outputs)
        self.register_buffer("shares_of_direct", torch.tensor(SHARES_OF_DIRECT), persistent=False)
        self.least_specular = settings.least_specular
        self.lit_points = transport(frame, settings.lit_points) if transport else None
        self.photon_light = photon_light

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure, as every network's."""
        further, inputs = self.further(inputs), self.raise_specular(inputs)
        if not self.filters_direct:
            return self.known(inputs, further) + self.factor(inputs) * self.synthesise(self.channels(inputs, further))
        seen, filtered = self.filter_direct(inputs)
        made = self.synthesise(self.channels(inputs, [*further, *seen]))
        quieter = self.share_direct(filtered, made)
        return self.known(inputs, further) + quieter + self.factor(inputs) * made[..., :LIGHT]

    @torch.no_grad()
    def filter_direct(self, inputs: Inputs) -> tuple[list[Tensor], Tensor]:
        """Direct light, filtered finely and coarsely: channels of it, and what that adds, (B, H, W, 3, 2)."""
        guides = require(inputs.guides)
        plain = guides.direct + guides.gloss
        reflects = reflectance(inputs.albedo, guides) + REFLECTANCE_FLOOR
        variance, places = estimate_variance(plain, reflects), self.measure_places(inputs)
        filtered = filter_light(plain, reflects, variance, inputs.normal, places)
        shows = floor(inputs.albedo, guides) / REFLECTANCE_FLOOR
        seen = [torch.log1p((light / reflects).clamp(min=0)) for light in filtered]
        return seen, torch.stack([shows * (light - plain) for light in filtered], dim=-1)

    def share_direct(self, filtered: Tensor, made: Tensor) -> Tensor:
        """What the learned shares of filtered direct light, the last outputs, add to the image, (B, H, W, 3)."""
        shares = torch.softmax(self.shares_of_direct + made[..., -len(SHARES_OF_DIRECT) :], dim=-1)
        return (filtered * shares[..., None, 1:]).sum(dim=-1)

    def measure_places(self, inputs: Inputs) -> Tensor:
        """Where each pixel's surface is, from the eye, over the scene's size, (B, H, W, 3)."""
        to_camera = inputs.world_to_camera
        rays = self.optics.rays(to_camera, inputs.focal_px)
        ahead = (rays * to_camera[:, None, None, 2, :3]).sum(-1)
        return rays * (inputs.depth / (ahead * self.scale))[..., None]

    def raise_specular(self, inputs: Inputs) -> Inputs:
        """The inputs in which whatever shines reflects at least the settings' `least_specular`; without, themselves.

        Not for `further`, as glossy pixels are counted before [inputs.Inputs.to], by what the guides found.
        """
        if not self.least_specular:
            return inputs
        return replace(inputs, guides=require(inputs.guides).reflect_at_least(self.least_specular))

    def channels(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """Further channels, guides, and the image-space channels, (B, H, W, C)."""
        return torch.cat([*further, *guide_channels(inputs, self.scale), self.image_space(inputs)], dim=-1)

    def factor(self, inputs: Inputs) -> Tensor:
        """Reflectance, with its least value, (B, H, W, 3)."""
        guides = require(inputs.guides)
        return reflectance(inputs.albedo, guides) + floor(inputs.albedo, guides)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """log(1 + light), (B, H, W, 3) each: of lit points, then of photons in each window."""
        channels = [] if self.lit_points is None else self.lit_points(inputs)
        gathered = [] if self.photon_light is None else self.photon_light(inputs)
        return [torch.log1p(light) for light in (*channels, *gathered)]

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """Emission, reflected direct light, and albedo times further diffuse light, (B, H, W, 3).

        The further light is that of all lit points, or else that of photons in the widest window.
        """
        light = show_known_light(inputs)
        if self.lit_points is None and self.photon_light is None:
            return light
        return light + inputs.albedo * torch.expm1(further[-1] if self.lit_points is None else further[DIFFUSE])
