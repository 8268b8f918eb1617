"""A guided network that is also given one noisy half of the view, and learns from the other one. All ours.

guess = w · filtered half + (1 − w) · known light + reflectance × U-Net
image = guess + v · (half − guess),   v = β / (β + s)

The filtered half is a denoiser's image of half A [predictors.half_filter], or that of the filter below. The weight w
of each pixel is learned, and starts at `START`. β, the squared relative error of the guess, is learned; s, the squared
relative noise of the half, is estimated from its passes, or from its neighbourhood where it has one pass. So v is the
weight by which two independent estimates have the least error: as samples are added, s falls and the image goes on to
their mean (the weights of Back et al., Deep Combiner, 2020, are learned instead). All inputs depend on half A alone,
so that half B is an unbiased target; A and B take turns [data.batch].

Shape letters: B batch, H W image.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from photonfarm.trainer.networks.guided import REFLECTANCE_FLOOR, Guided, floor
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, SceneFrame, reflectance, require
from photonfarm.trainer.networks.lit_points import LitPoints
from photonfarm.trainer.runs.settings import NetworkSettings

START = 2.0
"""The logit of the weight of the filtered half before anything is learned: 0.88."""

TRUSTED = -4.0
"""What β starts from, before softplus: 0.02, an error of 13 %."""

WINDOWS = (5, 13)
"""The windows, in pixels, in which the half's light over reflectance is given to the U-Net, beside each pixel's."""

HALF_CHANNELS = 3 + 3 * (1 + len(WINDOWS)) + 3 + 3 + 1
"""The half, its light of each pixel and in `WINDOWS`, the filtered half, its light, and the noise."""

DARK = 0.1
"""The brightness, in exposed radiance, that noise is relative to in darker places."""

LEVELS = 4
"""The passes of the filter, with neighbours at 1, 2, 4 and 8 pixels."""


class GuidedDenoise(Guided):
    """Image synthesis from guides, lit points and a noisy half of the view, joined with the half and its filtering."""

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, transport=LitPoints, further=HALF_CHANNELS, outputs=3 + 2)
        self._is_given_filtered = settings.filter.startswith("oidn")

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure. What reflects nothing shows what it emits."""
        noisy, lit = require(inputs.noisy), self.further(inputs)
        if self._is_given_filtered:
            require(noisy.filtered)
        half = look_at_half(inputs, noisy, self._measure_places(inputs))
        known = self.known(inputs, lit)
        made = self.synthesise(self.channels(inputs, [*half.channels, *lit]))
        light, weight, trust = made[..., :3], torch.sigmoid(START + made[..., 3:4]), made[..., 4:5]
        guess = known + half.shows * weight * (half.filtered - known) + self.factor(inputs) * light
        error = functional.softplus(TRUSTED + trust)
        return guess + half.shows * (error / (error + half.noise)) * (noisy.colour - guess)

    def _measure_places(self, inputs: Inputs) -> Tensor:
        """Where each pixel's surface is, from the eye, over the scene's size, (B, H, W, 3)."""
        to_camera = inputs.world_to_camera
        rays = self.optics.rays(to_camera)
        ahead = (rays * to_camera[:, None, None, 2, :3]).sum(-1)
        return rays * (inputs.depth / (ahead * self.scale))[..., None]


class Half(NamedTuple):
    """What a network sees of a half, without gradients."""

    filtered: Tensor  # (B, H, W, 3)
    noise: Tensor  # (B, H, W, 1) its variance over its squared brightness
    shows: Tensor  # (B, H, W, 1) 0 where nothing reflects, and the known light is all there is; else 1
    channels: list[Tensor]  # `HALF_CHANNELS` in all


@torch.no_grad()
def look_at_half(inputs: Inputs, noisy: NoisyColour, places: Tensor) -> Half:
    """Filter a half, unless that is done, and estimate its noise; `places` are those of surfaces, (B, H, W, 3)."""
    guides = require(inputs.guides)
    shows = floor(inputs.albedo, guides) / REFLECTANCE_FLOOR
    reflects = reflectance(inputs.albedo, guides) + REFLECTANCE_FLOOR
    direct = guides.emission + guides.direct + guides.gloss
    light = noisy.colour - direct
    spread = _estimate_variance(light, reflects)
    if noisy.variance is not None:
        spread = torch.where(noisy.variance[..., None] < 0, spread, _mean(noisy.variance[..., None], 5))
    filtered = noisy.filtered
    if filtered is None:
        filtered = direct + filter_light(light, reflects, spread, inputs.normal, places)
    brightness = filtered.mean(dim=-1, keepdim=True)
    noise = spread / (brightness**2 + DARK**2)
    averages = [light / reflects, *(_smooth(light, reflects, size) for size in WINDOWS)]
    images = [noisy.colour / reflects, *averages, filtered / reflects, (filtered - direct) / reflects, noise]
    return Half(filtered, noise, shows, [shows * image.sign() * torch.log1p(image.abs()) for image in images])


def _estimate_variance(light: Tensor, reflects: Tensor) -> Tensor:
    """The variance of the mean colour from neighbours, (B, H, W, 1): of light over reflectance, as that is smooth.

    The square of a pixel less the mean over 3 × 3 is 8/9 of it, where nothing but noise differs.
    """
    rest = (light - reflects * _smooth(light, reflects, 3)).mean(dim=-1, keepdim=True)
    return 9 / 8 * _mean(rest**2, 5)


def _mean(image: Tensor, size: int) -> Tensor:
    """The mean over windows of size × size pixels, cut at the border, (B, H, W, C)."""
    planes, reach = image.permute(0, 3, 1, 2).contiguous(), size // 2
    for window, padding in (((size, 1), (reach, 0)), ((1, size), (0, reach))):
        planes = functional.avg_pool2d(planes, window, stride=1, padding=padding, count_include_pad=False)
    return planes.permute(0, 2, 3, 1)


def _smooth(light: Tensor, reflects: Tensor, size: int) -> Tensor:
    """Light over reflectance in windows, (B, H, W, 3): a ratio of sums, in which dark surfaces count the least."""
    both = _mean(torch.cat([light, reflects], dim=-1), size)
    return both[..., :3] / both[..., 3:]


def filter_light(light: Tensor, reflects: Tensor, variance: Tensor, normal: Tensor, places: Tensor) -> Tensor:
    """Light, (B, H, W, 3), filtered by its own noise and the surfaces: an à-trous filter as a ratio of sums.

    Neighbours count by Σ k w light / Σ k w reflectance, 3 × 3 at growing distances (Dammertz et al., Edge-avoiding
    À-Trous, 2010). w falls with the angle of normals, the distance from the tangent plane, and the difference of
    brightness over its standard deviation, which is carried from pass to pass (Schied et al., SVGF, 2017).
    """
    height, width = light.shape[1:3]
    weighted, weight = light, reflects.mean(dim=-1, keepdim=True).expand_as(light)
    weighted = weighted / reflects * weight
    variance = variance / weight[..., :1] ** 2
    for level in range(LEVELS):
        step = 1 << level
        value = weighted / weight
        bright = value.mean(dim=-1, keepdim=True)
        allowed = 4 * _mean(variance, 3).clamp(min=0).sqrt() + 1e-3
        packed = torch.cat([weighted, weight[..., :1], variance, bright, normal, places], dim=-1)
        around = functional.pad(packed.permute(0, 3, 1, 2), (step,) * 4, mode="replicate").permute(0, 2, 3, 1)
        sums = torch.zeros_like(packed[..., :5])
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                rows, columns = step * (1 + down), step * (1 + right)
                there = around[:, rows : rows + height, columns : columns + width]
                apart = 12 * (there[..., 6:9] - normal).square().sum(-1, keepdim=True)
                apart += (normal * (there[..., 9:12] - places)).sum(-1, keepdim=True).abs() / (0.01 * step)
                apart += (there[..., 5:6] - bright).abs() / allowed
                counts = 0.25 * 0.5 ** (abs(down) + abs(right)) * torch.exp(-apart)
                sums[..., :4] += counts * there[..., :4]
                sums[..., 4:] += (counts * there[..., 3:4]) ** 2 * there[..., 4:5]
        weighted, weight, variance = sums[..., :3], sums[..., 3:4].expand_as(light), sums[..., 4:] / sums[..., 3:4] ** 2
    return reflects * weighted / weight
