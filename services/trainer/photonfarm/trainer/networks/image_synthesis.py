"""The Image Synthesis Layer: a U-Net from projected features and image-space buffers to RGB [supplement 1.3, Fig. 2].

Shape letters: B batch, H W image, C channels. The height and width must be divisible by 8.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.trainer.runs.settings import Precision

HALVINGS = 3


class ConvBlock(nn.Module):
    """A residual block of two 3×3 convolutions at constant width, activations before each [supplement Fig. 2]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _conv(width, width)
        self.second = _conv(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) → (B, C, H, W)."""
        return x + self.second(torch.relu(self.first(torch.relu(x))))


class ImageSynthesisLayer(nn.Module):
    """Three halvings by max-pooling at widths d, 2d, 4d, 8d; bilinear up, joined with the encoder's block outputs.

    Ours where the figure gives no details: 3×3 convolutions between the widths, no normalisation, no activation at the
    end. With `precision` "bfloat16" it computes in that type except for the last convolution, so that the image and the
    loss are float32, as are all weights.
    """

    def __init__(self, channels_in: int, width: int, precision: Precision = "float32") -> None:
        super().__init__()
        self.precision = precision
        widths = [width << level for level in range(HALVINGS + 1)]
        self.enter = nn.ModuleList(_conv(a, b) for a, b in pairwise([channels_in, *widths]))
        self.encode = nn.ModuleList(ConvBlock(w) for w in widths)
        self.join = nn.ModuleList(_conv(fine + coarse, fine) for fine, coarse in pairwise(widths))
        self.decode = nn.ModuleList(ConvBlock(w) for w in widths[:-1])
        self.out = _conv(width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels_in, H, W) → (B, 3, H, W), exposed linear radiance."""
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            x = self._features(x)
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


def _conv(channels_in: int, channels_out: int) -> nn.Conv2d:
    return nn.Conv2d(channels_in, channels_out, kernel_size=3, padding=1)
