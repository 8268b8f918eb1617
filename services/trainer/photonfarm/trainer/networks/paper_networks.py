"""The networks of the paper: light transport without and with photons, and the baselines [supplement 1, 4].

Points → light transport → projection → image synthesis. The Light Transport Layer is two PointNet blocks over the
scene's point cloud [supplement 1.1, Fig. 1]. The figure concatenates each point's features l with the maximum g over
all points. Here the two stay apart until the end: W [l, g] = W_l l + W_g g, and W_g g is computed once per cloud, not
once per point. It is the same function at about half the work.

Of the baselines, `cnn` has no inputs but the image-space buffers, `denoise(1/k)` also has one of k pixels of a noisy
image, and `feature_projection` has its scene's points.

Shape letters: B batch, P points, K photon slots, F features of a point, L features of each point, G features of the
cloud, H W image.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.trainer.networks.inputs import Inputs, PointInputs, SceneFrame, require
from photonfarm.trainer.networks.network import Network, make_descriptors
from photonfarm.trainer.networks.photon_map import WINDOWS, PhotonLight
from photonfarm.trainer.runs.settings import NetworkSettings


class FeatureProjection(Network):
    """Each point's learnable descriptor, projected unchanged [supplement Table 1, "Feature projection"].

    A descriptor moves with its point, and is the same in every configuration.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=settings.descriptor)
        self.descriptor = make_descriptors(len(frame.appearance), settings)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The descriptors, averaged over the points in each pixel, (B, H, W, descriptor)."""
        points = require(inputs.points)
        features = self.descriptor.expand(len(points.position), -1, -1)
        return [self.project(features, points.position, points.present, points.seen, inputs)]


class Cnn(Network):
    """Image synthesis from the image-space channels alone [supplement Table 1, "CNN only"]."""


NARROWER = 2
"""How many times narrower the denoiser's U-Net is than the others': half as wide, it has about a quarter of the work.

This is inferred: the paper's times of `denoise(1/k)` fit 1.50 s / k for rendering + 0.005 s, where the full U-Net takes
0.019 s [method 2, 4].
"""


class Denoiser(Network):
    """A light U-Net over sparse noisy colour, the mask of the kept pixels, and the image-space channels.

    It is trained on pairs of independent noisy halves (Lehtinen et al., Noise2Noise, 2018): its input is never in its
    target. The colour is linear; the share of kept pixels affects only its weights, not its structure.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=3 + 1, narrower=NARROWER)

    def forward(self, inputs: Inputs) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure; with reflectance for albedo, where it is given."""
        return super().forward(replace(inputs, albedo=inputs.reflects))

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The noisy colour, zero where not kept, and the mask, (B, H, W, 3) and (B, H, W, 1)."""
        noisy = require(inputs.noisy)
        return [noisy.colour, noisy.kept[..., None].to(noisy.colour)]


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
        hidden = _apply_split(self.hidden, torch.relu(local), torch.relu(shared))
        return _apply_split(self.shortcut, local, shared) + self.out(torch.relu(hidden))


def _apply_split(layer: nn.Linear, local: Tensor, shared: Tensor) -> Tensor:
    """Apply `layer` to [local, shared] of each point, (B, P, L) and (B, G), without concatenating the two."""
    local_weight, shared_weight = torch.split(layer.weight, [local.shape[-1], shared.shape[-1]], dim=1)
    return functional.linear(local, local_weight) + functional.linear(shared, shared_weight, layer.bias)[:, None]


def masked_max(x: Tensor, present: Tensor) -> Tensor:
    """The maximum over present points, (B, P, F) and (B, P) → (B, F); zero if no point is present."""
    maximum = x.masked_fill(~present[..., None], -torch.inf).amax(dim=1)
    return maximum.masked_fill(~present.any(dim=1, keepdim=True), 0)


class LightTransportLayer(nn.Module):
    """Features of each point that depend on the whole scene: the second block's own, and their maximum over points.

    Ours where the figure gives no details: weights start with variance 1 / inputs [LeCun et al. 1998], so that features
    of size 1 stay so. By torch's default, a third of that, they would enter the U-Net far below its other channels.
    """

    def __init__(self, varying: int, fixed: int) -> None:
        super().__init__()
        self.preprocess = nn.Linear(varying + fixed, WIDTH)
        nn.init.kaiming_uniform_(self.preprocess.weight, nonlinearity="linear")
        self.blocks = nn.ModuleList([ResidualBlock(), ResidualBlock()])

    def forward(self, varying: Tensor, fixed: Tensor, present: Tensor, base_cloud: Tensor | None = None) -> Tensor:
        """p_i and present (B, P) → f_i (B, P, 64).

        p_i comes in two parts: values that differ between samples (B, P, F), and constants (P, F′); where these change,
        too, they are (B, P, F′), with those of the base cloud behind. The maxima of the
        `base_cloud` (P, F), if given, are subtracted, which is ours: a moved lamp's effect on maxima is small beside
        what all configurations have in common, and would be lost in the optimiser's changes to that.
        """
        samples = len(varying)
        if base_cloud is not None:  # one more sample, the last, with all points present
            varying = torch.cat([varying, base_cloud[None]])
            present = torch.cat([present, present.new_ones(1, present.shape[1])])
        w_varying, w_fixed = torch.split(self.preprocess.weight, [varying.shape[-1], fixed.shape[-1]], dim=1)
        local = functional.linear(varying, w_varying) + functional.linear(fixed, w_fixed, self.preprocess.bias)
        shared = local.new_zeros(len(local), 0)  # nothing yet, before the first block
        for block in self.blocks:
            local = block(local, shared)
            shared = masked_max(local, present)
            if base_cloud is not None:
                shared = (shared - shared[-1:]).masked_fill(~present.any(dim=1, keepdim=True), 0)
        local, shared = local[:samples], shared[:samples]
        return torch.cat([local, shared[:, None].expand_as(local)], dim=-1)


class LightTransport(Network):
    """The supplement's network without photons: "Ours (w/o photons)"."""

    appearance: Tensor
    base: Tensor

    def __init__(self, settings: NetworkSettings, frame: SceneFrame, *, further: int = WIDTH) -> None:
        super().__init__(settings, frame, further=further)
        points, appearance = frame.appearance.shape
        self.register_buffer("appearance", torch.from_numpy(frame.appearance), persistent=False)
        self.register_buffer("base", torch.from_numpy(frame.base), persistent=False)
        self.relative = settings.maxima == "relative"
        self._normalise = frame.normalise_emission if frame.changes else None
        self.descriptor = make_descriptors(points, settings)
        self.light_transport = LightTransportLayer(self.coordinate_count, appearance + settings.descriptor)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """f_i, averaged over the points in each pixel, (B, H, W, 64)."""
        points = require(inputs.points)
        return [self.project(self.point_features(points), points.position, points.present, points.seen, inputs)]

    def point_features(self, points: PointInputs) -> Tensor:
        """f_i (B, P, 64) from p_i: current world position, then normal, albedo, emission and learnable descriptor."""
        fixed = torch.cat([self.appearance, self.descriptor], dim=1)
        base_cloud = self.coordinates(self.base) if self.relative else None
        if self._normalise is not None:  # in this scene constants change, too
            constant, count = fixed, len(points.position)
            emission = self._normalise(require(points.emission))
            albedo, descriptor = (each.expand(count, -1, -1) for each in (constant[:, 3:6], self.descriptor))
            fixed = torch.cat([require(points.normal), albedo, emission, descriptor], dim=-1)
            fixed = torch.cat([fixed, constant[None]]) if self.relative else fixed
        return self.light_transport(self.coordinates(points.position), fixed, points.present, base_cloud)


class LightTransportPhotons(LightTransport):
    """The supplement's network with photons of the current configuration, "Ours (w/ photons)"; the design is ours.

    Its inputs include the light that photons bring to windows of the image; and that of the widest window, times
    albedo, is the image that its output is added to. No input depends on the number of photons except by its noise.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        photon_light = PhotonLight(frame, settings.architecture)  # first, as it refuses a scene without photons
        super().__init__(settings, frame, further=WIDTH + 3 * len(WINDOWS))
        self.photon_light = photon_light

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The points' features, and log(1 + light gathered in each window), (B, H, W, 3) each."""
        return [*super().further(inputs), *(torch.log1p(radiance) for radiance in self.photon_light(inputs))]

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor:
        """Albedo times the light of the widest window: the photon map's image of diffuse surfaces."""
        return inputs.albedo * torch.expm1(further[-1])
