"""A guided network that is also given one noisy half of the view, and learns from the other one. All ours.

filtered = Σ shares · filtered halves
guess = filtered + ((1 − w) · (known light − filtered) + reflectance × U-Net) / √n
image = guess + v · (half − guess),   v = β/√n / (β/√n + s)

The half is filtered by the two scales of a filter of our own, below, and where it is installed by a denoiser
[predictors.half_filter]: errors of filters that work differently are less in their mean. Shares and w are learned for
each pixel; w starts at 0.88. s, the squared relative noise of the half, is estimated from its passes, or from its
neighbourhood where it has one alone. β, the squared relative error of the guess, is learned, and v is the weight by
which two independent estimates have the least error: in the end the image goes on to the mean of the samples (Back et
al., Deep Combiner, 2020, learn such weights). All inputs depend on half A alone, so half B is an unbiased target; the
two take turns [data.batch].

n is the number of passes of the half. The squared error of a denoiser falls by √n (docs/results/networks.md), and that
of what is known without any sample does not fall. So with √n fades what the network learned to set against the noise of
one pass: what it adds, its error, the share of the coarse filter, whose window stays as wide, and what the settings'
filter of direct light changes in our filtered halves. By the same factor the half takes over from the known light where
nothing reflects by the guides, which do not see all paths. And where the guess is further from the half than noise
explains, v is at least 1 − (1 + 4/n) · variance / (half − guess)², both means over 5 × 5 pixels (James and Stein, 1961,
with slack for a variance that is itself estimated from n passes).

Shape letters: B batch, H W image.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from photonfarm.trainer.networks.guided import REFLECTANCE_FLOOR, Guided, floor, show_known_light
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, SceneFrame, reflectance, require
from photonfarm.trainer.networks.light_filter import estimate_variance, filter_light, smooth, take_means
from photonfarm.trainer.networks.lit_points import LitPoints
from photonfarm.trainer.runs.settings import NetworkSettings

START = 2.0
"""The logit of the weight of the filtered half before anything is learned: 0.88."""

TRUSTED = -4.0
"""What β starts from, before softplus: 0.02, an error of 13 %."""

WINDOWS = (5, 13)
"""The windows, in pixels, in which the half's light over reflectance is given to the U-Net, beside each pixel's."""

HALF_CHANNELS = 3 + 3 * (1 + len(WINDOWS)) + 1
"""The half, its light of each pixel and in `WINDOWS`, and its noise."""

SHARES = (-3.0, 0.0, 1.0)
"""The logits of what is filtered before anything is learned: finely, coarsely, by a denoiser."""

OURS = 2
"""So many of these are ours: they filter what the known direct light does not explain, and add that light again."""

DARK = 0.1
"""The brightness, in exposed radiance, that noise is relative to in darker places."""

COARSE = (0.0, 1.0, 0.0)
"""1 for what is filtered coarsely, in the order of `SHARES`."""

TINY = 1e-12
"""A squared difference that is none."""


class GuidedDenoise(Guided):
    """Image synthesis from guides, lit points and a noisy half of the view, joined with the half and its filtering."""

    shares: Tensor
    coarse: Tensor

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        filters = OURS + settings.has_denoiser
        further, outputs = HALF_CHANNELS + 6 * filters, 3 + 2 + filters
        super().__init__(settings, frame, transport=LitPoints, further=further, outputs=outputs)
        self._has_denoiser = settings.has_denoiser
        self.register_buffer("shares", torch.tensor(SHARES[:filters]), persistent=False)
        self.register_buffer("coarse", torch.tensor(COARSE[:filters]), persistent=False)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure.

        Of one pass, what reflects nothing shows what it emits.
        """
        lit, inputs = self.further(inputs), self.raise_specular(inputs)
        noisy = require(inputs.noisy)
        denoised = require(noisy.filtered) if self._has_denoiser else None
        half = look_at_half(inputs, noisy, self.measure_places(inputs), denoised)
        known = self.known(inputs, lit)
        seen, smoothed = self.filter_direct(inputs) if self.filters_direct else ([], None)
        made = self.synthesise(self.channels(inputs, [*half.channels, *lit, *seen]))
        light, weight = self.factor(inputs) * made[..., :3], torch.sigmoid(START + made[..., 3:4])
        passes = torch.ones_like(noisy.colour[:, 0, 0, 0]) if noisy.passes is None else noisy.passes
        fading = 1 / passes.sqrt()[:, None, None, None]
        error = fading * functional.softplus(TRUSTED + made[..., 4:5])
        logits = self.shares + made[..., 5 : 5 + len(self.shares)]
        shares = torch.softmax(logits + self.coarse * fading.log(), dim=-1)
        filtered = (half.filtered * shares[..., None, :]).sum(dim=-1)
        if smoothed is not None:
            quieter = self.share_direct(smoothed, made)
            known = known + quieter
            filtered = filtered + fading * shares[..., :OURS].sum(dim=-1, keepdim=True) * quieter
        added = fading * ((1 - weight) * (known - filtered) + light)
        shows = half.shows + (1 - half.shows) * (1 - fading)
        guess = torch.lerp(known + light, filtered + added, shows)
        apart = noisy.colour - guess
        further = take_means(apart.detach().mean(dim=-1, keepdim=True) ** 2, 5).clamp(min=TINY)
        doubt = torch.where(fading < 1, 1 - (1 + 4 * fading**2) * half.variance / further, 0)
        share = torch.maximum(error / (error + half.noise), doubt)
        return guess + shows * share * apart


class Half(NamedTuple):
    """What a network sees of a half, without gradients."""

    filtered: Tensor  # (B, H, W, 3, n) by each filter
    variance: Tensor  # (B, H, W, 1) of its mean colour
    noise: Tensor  # (B, H, W, 1) that over its squared brightness
    shows: Tensor  # (B, H, W, 1) 0 where nothing reflects, and the known light is all there is; else 1
    channels: list[Tensor]  # `HALF_CHANNELS`, and 6 of each filter


@torch.no_grad()
def look_at_half(inputs: Inputs, noisy: NoisyColour, places: Tensor, denoised: Tensor | None = None) -> Half:
    """Filter a half, and estimate its noise; `places` are those of surfaces, (B, H, W, 3).

    The filters are our own, and that of the `denoised` half, (B, H, W, 3), if there is one.
    """
    guides = require(inputs.guides)
    shows = floor(inputs.albedo, guides) / REFLECTANCE_FLOOR
    reflects = reflectance(inputs.albedo, guides) + REFLECTANCE_FLOOR
    direct = show_known_light(inputs)
    light = noisy.colour - direct
    variance = estimate_variance(light, reflects)
    if noisy.passes is not None and noisy.variance is not None:
        several = noisy.passes[:, None, None, None] > 1
        variance = torch.where(several, take_means(noisy.variance[..., None], 5), variance)
    fine, coarse = (direct + image for image in filter_light(light, reflects, variance, inputs.normal, places))
    brightness = coarse.mean(dim=-1, keepdim=True)
    noise = variance / (brightness**2 + DARK**2)
    filtered = [fine, coarse] if denoised is None else [fine, coarse, denoised]
    averages = [light / reflects, *(smooth(light, reflects, size) for size in WINDOWS)]
    images = [noisy.colour / reflects, *averages, noise]
    images += [image / reflects for each in filtered for image in (each, each - direct)]
    channels = [shows * image.sign() * torch.log1p(image.abs()) for image in images]
    return Half(torch.stack(filtered, dim=-1), variance, noise, shows, channels)
