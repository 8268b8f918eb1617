"""Convolutions whose factors are rounded to TF32, on any device: what tensor cores compute, but for the order of sums.

TF32 has float32's exponent and 10 of its 23 bits of mantissa; products are exact and sums float32.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

DROPPED = 23 - 10  # bits of the mantissa


def rounded(x: Tensor) -> Tensor:
    """The nearest TF32 values, ties to even; values must be finite."""
    bits = x.view(torch.int32)
    half = (1 << (DROPPED - 1)) - 1 + ((bits >> DROPPED) & 1)
    return ((bits + half) & ~((1 << DROPPED) - 1)).view(torch.float32)


class _Convolution(torch.autograd.Function):
    """A 3×3 convolution with rounded factors, and its gradients, which are convolutions with rounded factors too."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        x, weight = rounded(x), rounded(weight)
        ctx.save_for_backward(x, weight)
        return functional.conv2d(x, weight, bias, padding=1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        wanted = (ctx.needs_input_grad[0], True, False)
        shape = (None, (1, 1), (1, 1), (1, 1), False, (0, 0), 1)  # bias, stride, padding, dilation, and the defaults
        of_x, of_weight, _ = torch.ops.aten.convolution_backward(rounded(gradients[0]), x, weight, *shape, wanted)
        return of_x, of_weight, gradients[0].sum(dim=(0, 2, 3))


class RoundedConv2d(nn.Conv2d):
    """A 3×3 convolution at padding 1 as TF32 has it."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) → (B, C′, H, W)."""
        return _Convolution.apply(x, self.weight, self.bias)  # type: ignore[no-untyped-call]


def round_factors(network: nn.Module) -> None:
    """Let all convolutions of a network round their factors."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            layer.__class__ = RoundedConv2d
