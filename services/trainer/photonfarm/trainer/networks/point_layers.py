"""The Light Transport Layer: two PointNet blocks over the scene's point cloud [supplement 1.1, Fig. 1].

The figure concatenates each point's features with the maximum over all points. Here the two halves stay apart, one row
per point and one per cloud, until the end: W [l, g] = W_l l + W_g g is the same function at about half the work.

Shape letters: B batch, P points, F features of a point, L features of each point, G features of the cloud.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTH = 64
"""The width of the layer's output and of each block's input [supplement Fig. 1]."""

LOCAL = WIDTH // 2
"""The width of the per-point half of a block's output; the other half is the maximum over points."""


class ResidualBlock(nn.Module):
    """A fully connected residual block 64 → 32, activations before each layer [supplement Fig. 1].

    Ours where the figure gives no details: the last layer starts at zero and the shortcut has no bias, so that a block
    starts as a linear map.
    """

    def __init__(self) -> None:
        super().__init__()
        self.hidden = nn.Linear(WIDTH, LOCAL)
        self.out = nn.Linear(LOCAL, LOCAL)
        self.shortcut = nn.Linear(WIDTH, LOCAL, bias=False)
        for layer in (self.hidden, self.shortcut):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="linear")
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, local: Tensor, shared: Tensor) -> Tensor:
        """(B, P, L) and (B, G) with L + G = 64 → (B, P, 32)."""
        hidden = _linear(self.hidden, torch.relu(local), torch.relu(shared))
        return _linear(self.shortcut, local, shared) + self.out(torch.relu(hidden))


def _linear(layer: nn.Linear, local: Tensor, shared: Tensor) -> Tensor:
    """Apply `layer` to each point's [local, shared], without building it."""
    own, common = torch.split(layer.weight, [local.shape[-1], shared.shape[-1]], dim=1)
    return functional.linear(local, own) + functional.linear(shared, common, layer.bias)[:, None]


def masked_max(x: Tensor, present: Tensor) -> Tensor:
    """The maximum over present points, (B, P, F) and (B, P) → (B, F); zero if no point is present."""
    maximum = x.masked_fill(~present[..., None], -torch.inf).amax(dim=1)
    return torch.where(present.any(dim=1, keepdim=True), maximum, 0)


class LightTransportLayer(nn.Module):
    """Features of each point that depend on the whole scene; the output is that of the second block.

    Ours where the figure gives no details: weights start with variance 1 / inputs [LeCun et al. 1998], so that features
    of size 1 stay so. By torch's default, a third of that, they would enter the U-Net far below its other channels.
    """

    def __init__(self, varying: int, fixed: int) -> None:
        super().__init__()
        self.preprocess = nn.Linear(varying + fixed, WIDTH)
        nn.init.kaiming_uniform_(self.preprocess.weight, nonlinearity="linear")
        self.blocks = nn.ModuleList([ResidualBlock(), ResidualBlock()])

    def forward(self, varying: Tensor, fixed: Tensor, present: Tensor, reference: Tensor | None = None) -> Tensor:
        """p_i and present (B, P) → f_i (B, P, 64).

        p_i comes in two parts: values that differ between samples (B, P, F), and constants (P, F′). With a reference, a
        cloud (P, F) of which all points are present, its maxima are subtracted, which is ours: the effect of a moved
        lamp on them is small beside what all configurations have in common, and would be lost in the optimiser's
        changes to that.
        """
        samples = len(varying)
        if reference is not None:
            varying = torch.cat([varying, reference[None]])
            present = torch.cat([present, present.new_ones(1, present.shape[1])])
        own, common = torch.split(self.preprocess.weight, [varying.shape[-1], fixed.shape[-1]], dim=1)
        local = functional.linear(varying, own) + functional.linear(fixed, common, self.preprocess.bias)
        shared = local.new_zeros(len(local), 0)
        for block in self.blocks:
            local = block(local, shared)
            shared = masked_max(local, present)
            if reference is not None:
                shared = torch.where(present.any(dim=1, keepdim=True), shared - shared[-1:], 0)
        local, shared = local[:samples], shared[:samples]
        return torch.cat([local, shared[:, None].expand_as(local)], dim=-1)
