"""The base of all networks: features of each pixel, then image synthesis [supplement 1.3].

The Image Synthesis Layer is a U-Net from projected features and image-space buffers to RGB [supplement Fig. 2]. The
height and width must be divisible by 8.

Shape letters: B batch, P points, H W image, C channels.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.trainer.networks.inputs import Inputs, SceneFrame
from photonfarm.trainer.networks.projection import footprint, project_mean
from photonfarm.trainer.runs.devices import is_asynchronous, round_convolutions
from photonfarm.trainer.runs.settings import NetworkSettings, Precision

HALVINGS = 3


class ConvBlock(nn.Module):
    """A residual block of two 3×3 convolutions at constant width, activations before each [supplement Fig. 2]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = Convolution(width, width)
        self.second = Convolution(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) → (B, C, H, W)."""
        return x + self.second(torch.relu(self.first(torch.relu(x))))


class ImageSynthesisLayer(nn.Module):
    """Three halvings by max-pooling at widths d, 2d, 4d, 8d; bilinear up, joined with the encoder's block outputs.

    Ours where the figure gives no details: 3×3 convolutions between the widths, no normalisation, no activation at the
    end. With `precision` "bfloat16" it computes in that type except for the last convolution, so that the image and the
    loss are float32, as are all weights.
    """

    def __init__(self, channels_in: int, width: int, precision: Precision = "float32", outputs: int = 3) -> None:
        super().__init__()
        self.precision = precision
        widths = [width << level for level in range(HALVINGS + 1)]
        self.enter = nn.ModuleList(Convolution(a, b) for a, b in pairwise([channels_in, *widths]))
        self.encode = nn.ModuleList(ConvBlock(w) for w in widths)
        self.join = nn.ModuleList(Convolution(fine + coarse, fine) for fine, coarse in pairwise(widths))
        self.decode = nn.ModuleList(ConvBlock(w) for w in widths[:-1])
        self.out = Convolution(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels_in, H, W) → (B, outputs, H, W); 3 of them are exposed linear radiance."""
        x = self._features(x.bfloat16() if self.precision == "bfloat16" else x)
        return self.out(x.float())

    def _features(self, x: Tensor) -> Tensor:
        """(B, channels_in, H, W) → (B, width, H, W)."""
        skips = []
        for level, (enter, encode) in enumerate(zip(self.enter, self.encode, strict=True)):
            x = encode(enter(functional.max_pool2d(x, 2) if level else x))
            skips.append(x)
        skips.pop()
        for join, decode in reversed(list(zip(self.join, self.decode, strict=True))):
            x = functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = decode(join(torch.cat([skips.pop(), x], dim=1)))
        return x


CARD_CHANNELS = 8
"""The divisor of a convolution's channels for which cards have quick ones in every precision."""


class Convolution(nn.Conv2d):
    """A 3×3 convolution that keeps the size, in the precision of its input.

    On a card it has further channels of zeros, which change nothing.
    """

    bias: Tensor

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, kernel_size=3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) → (B, C′, H, W)."""
        weight, bias = self.weight.to(x.dtype), self.bias.to(x.dtype)
        more_in, more_out = (-count % CARD_CHANNELS for count in (self.in_channels, self.out_channels))
        if not is_asynchronous(x.device) or not (more_in or more_out):
            return functional.conv2d(x, weight, bias, padding=1)
        weight = functional.pad(weight, (0, 0, 0, 0, 0, more_in, 0, more_out))
        padded = functional.pad(x, (0, 0, 0, 0, 0, more_in))
        return functional.conv2d(padded, weight, functional.pad(bias, (0, more_out)), padding=1)[:, : self.out_channels]


IMAGE_CHANNELS = 10
"""The image-space channels: view ray 3, depth 1, albedo 3, normal 3 [supplement 1.3]."""


DESCRIPTOR_SIZE = 0.1
"""The initial standard deviation of descriptors.

At 1 they would hide position and emission in the maximum over the points, and the network would take far longer to
learn where lights are.
"""


def make_descriptors(points: int, settings: NetworkSettings) -> nn.Parameter:
    """The learnable numbers of each point, (P, descriptor), initialised."""
    return nn.Parameter(DESCRIPTOR_SIZE * torch.randn(points, settings.descriptor))


def add_octaves(x: Tensor, octaves: int) -> Tensor:
    """Coordinates near 1, (…, 3), with sin and cos of π/2 · 2ᵏ times each, k = 0 … octaves − 1: (…, 3 + 6 · octaves).

    From these, functions of the position are learned in far fewer steps (Tancik et al., Fourier Features, 2020).
    """
    angles = [x * (0.5 * math.pi * 2**octave) for octave in range(octaves)]
    return torch.cat([x, *(wave(angle) for angle in angles for wave in (torch.sin, torch.cos))], dim=-1)


class Network(nn.Module):
    """Image synthesis from the image-space channels, and from the further channels of a kind of network before them."""

    centre: Tensor

    def __init__(
        self, settings: NetworkSettings, frame: SceneFrame, *, further: int = 0, narrower: int = 1, outputs: int = 3
    ) -> None:
        """Take `further` channels beside the image-space ones; the U-Net is so many times `narrower` than set."""
        super().__init__()
        self.optics = frame.optics
        self.scale = frame.scale
        self.octaves = settings.octaves
        self.coordinate_count = 3 + 6 * settings.octaves
        self.demodulation = settings.demodulation
        self.register_buffer("centre", torch.from_numpy(frame.centre), persistent=False)
        width = max(settings.width // narrower, 1)
        self.image_synthesis = ImageSynthesisLayer(further + IMAGE_CHANNELS, width, settings.precision, outputs)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure: what is known + the U-Net's output × its factor."""
        further = self.further(inputs)
        return self.known(inputs, further) + self.factor(inputs) * self.synthesise(self.channels(inputs, further))

    def channels(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """All that the U-Net sees, (B, H, W, C)."""
        return torch.cat([*further, self.image_space(inputs)], dim=-1)

    def factor(self, inputs: Inputs) -> Tensor | float:
        """The factor of the U-Net's output: 1, or (B, H, W, 3).

        With demodulation, which is ours, it is albedo + ε: the network predicts the incident light. Because of ε,
        lamps, mirrors and glass, whose diffuse albedo is 0, have an image at all. Targets are not divided by albedo,
        which would weight their noise by a factor per pixel.
        """
        return 1.0 if self.demodulation is None else inputs.albedo + self.demodulation

    def further(self, inputs: Inputs) -> list[Tensor]:  # noqa: ARG002 - what the kinds see
        """The channels that this kind of network adds before the image-space channels, each (B, H, W, C)."""
        return []

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor | float:  # noqa: ARG002 - what the kinds see
        """The known part of the image, (B, H, W, 3), to which the learned output is added."""
        return 0.0

    def image_space(self, inputs: Inputs) -> Tensor:
        """View ray, depth, albedo and normal as one tensor, (B, H, W, 10)."""
        depth = inputs.depth[..., None] / self.scale
        return torch.cat(
            [self.optics.rays(inputs.world_to_camera, inputs.focal_px), depth, inputs.albedo, inputs.normal], dim=-1
        )

    def synthesise(self, channels: Tensor) -> Tensor:
        """(B, H, W, C) → (B, H, W, outputs). Channels stay last in memory, as CPUs and tensor cores take them."""
        round_convolutions(channels.device, self.image_synthesis.precision)
        return self.image_synthesis(channels.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)

    def coordinates(self, position: Tensor) -> Tensor:
        """World positions about the scene's centre, over half its diagonal, and their sines and cosines.

        (…, 3) → (…, 3 + 6 · octaves); see `add_octaves`.
        """
        return add_octaves((position - self.centre) / self.scale, self.octaves)

    def project(self, features: Tensor, position: Tensor, present: Tensor, seen: Tensor, inputs: Inputs) -> Tensor:
        """Features of points at world positions, (B, P, C), as the mean in each pixel, (B, H, W, C)."""
        view = inputs.world_to_camera, inputs.depth
        kept = footprint(position, present, seen, *view, self.optics, inputs.focal_px)
        return project_mean(features, kept, self.optics.height, self.optics.width)
