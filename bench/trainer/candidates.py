"""Networks that were tried and not kept, as users' own: `--architecture bench.trainer.candidates:NAME`.

Each is a network of ours with one part changed. Those with points differ from `guided_transport` in nothing but how
diffuse light goes from its lit points to each other and to the pixels.

Shape letters: B batch, P points, L lit points, H W image, N receivers, C numbers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.trainer.networks.guided import Guided
from photonfarm.trainer.networks.inputs import Inputs, Needs, SceneFrame
from photonfarm.trainer.networks.lit_points import HIDDEN, OCTAVES, LearnedVisibility, LitPoints
from photonfarm.trainer.networks.paper_networks import WIDTH, LightTransport
from photonfarm.trainer.runs.settings import NetworkSettings

SURFACE = 6 + 6 * OCTAVES
"""The numbers of a surface: its place, in sines and cosines, and its normal."""

KEYS = 32
"""The numbers of a surface whose products give how much it attends to another."""

TOKENS = 32
HEADS = 4

DARK = 2.0
"""Taken from what tokens show before it becomes light: rooms are darker than softplus(0)."""

REACH = 3
"""The pixels on each side from which a pixel without a point takes features."""


class _OfPoints(Guided):
    """`guided_transport` with points of another kind."""

    needs = Needs(guides=True)
    kind = LitPoints

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, transport=self.kind)


# ---------------------------------------------------------------------------------------------------------------- light


class _OneBounce(LitPoints):
    bounces = 1

    def arriving(self, at: Tensor, facing: Tensor, source: Tensor, sent: Tensor) -> tuple[Tensor, Tensor]:
        senders = self.visibility.surfaces(source, self.normal)
        between = self.form_factors(source, self.normal, source) * self.visibility(senders, senders)
        leaving = sent
        for _ in range(self.bounces):
            leaving = sent + self.albedo * (between @ leaving)
        return super().arriving(at, facing, source, leaving)


class OneBounce(_OfPoints):
    """Points light each other once: what they reflect of that light reaches the pixels, too."""

    kind = _OneBounce


class _TwoBounces(_OneBounce):
    bounces = 2


class TwoBounces(_OfPoints):
    """Points light each other twice."""

    kind = _TwoBounces


class _AllSeen(LearnedVisibility):
    """The visibility 1; it has no weights."""

    def __init__(self, frame: SceneFrame) -> None:
        super().__init__(frame)
        self.receiver = self.sender = nn.Sequential()
        del self.open

    def forward(self, receivers: Tensor, senders: Tensor) -> Tensor:  # noqa: ARG002 - what others see
        return receivers.new_ones(())


class _Unhidden(LitPoints):
    def __init__(self, frame: SceneFrame, count: int) -> None:
        super().__init__(frame, count)
        self.visibility = _AllSeen(frame)


class Unhidden(_OfPoints):
    """Nothing hides a point, and no visibility is learned."""

    kind = _Unhidden


# ------------------------------------------------------------------------------------------------------------ attention


class _Attention(_Unhidden):
    def __init__(self, frame: SceneFrame, count: int) -> None:
        super().__init__(frame, count)
        self.query, self.key = _layers(SURFACE, KEYS), _layers(SURFACE, KEYS)

    def form_factors(self, at: Tensor, facing: Tensor, source: Tensor) -> Tensor:
        surfaces = self.visibility.surfaces
        keys = self.key(surfaces(source, self.normal))
        return torch.softmax(self.query(surfaces(at, facing)) @ keys.T / math.sqrt(KEYS), dim=-1)


class Attention(_OfPoints):
    """Learned weights, which sum to 1 as form factors in a closed scene do, stand for form factor and visibility."""

    kind = _Attention


class _LatentTokens(_Unhidden):
    def __init__(self, frame: SceneFrame, count: int) -> None:
        super().__init__(frame, count)
        self.tokens = nn.Parameter(torch.randn(TOKENS, WIDTH))
        self.point, self.pixel, self.light = _layers(SURFACE + 6, WIDTH), _layers(SURFACE, WIDTH), _layers(WIDTH, 6)
        self.read, self.shown = (nn.MultiheadAttention(WIDTH, HEADS) for _ in range(2))

    def arriving(self, at: Tensor, facing: Tensor, source: Tensor, sent: Tensor) -> tuple[Tensor, Tensor]:
        surfaces = self.visibility.surfaces
        points = self.point(torch.cat([surfaces(source, self.normal), self.albedo, torch.log1p(sent)], dim=-1))
        tokens = self.tokens + self.read(self.tokens, points, points, need_weights=False)[0]
        pixels = self.pixel(surfaces(at, facing))
        light = self.light(pixels + self.shown(pixels, tokens, tokens, need_weights=False)[0])
        light = functional.softplus(light - DARK)
        return light[:, :3], light[:, 3:]


class LatentTokens(_OfPoints):
    """Some tokens read the lit points by attention, and pixels read light from these tokens by attention."""

    kind = _LatentTokens


def _layers(of: int, to: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(of, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, to))


# --------------------------------------------------------------------------------------------------------------- maxima


class MaximumBeside(Guided, LightTransport):
    """`guided`, and the projected features of the paper's Light Transport Layer, with its maxima over all points."""

    needs = Needs(guides=True)

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=WIDTH)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """f_i, averaged over the points in each pixel, (B, H, W, 64)."""
        return LightTransport.further(self, inputs)


class FilledProjection(LightTransport):
    """`light_transport`; a pixel without a point has the mean of those near it that have one."""

    needs = Needs()

    def project(self, features: Tensor, position: Tensor, present: Tensor, seen: Tensor, inputs: Inputs) -> Tensor:
        """(B, P, C) → (B, H, W, C)."""
        counted = torch.cat([features, features.new_ones(*features.shape[:2], 1)], dim=-1)
        found = super().project(counted, position, present, seen, inputs)
        near = functional.avg_pool2d(found.permute(0, 3, 1, 2), 2 * REACH + 1, 1, REACH).permute(0, 2, 3, 1)
        mean, there = near[..., :-1] / near[..., -1:].clamp(min=1e-6), found[..., -1:]
        return torch.where(there > 0, found[..., :-1], mean)
