"""The supplement's network, without and with photons: points → light transport → projection → image synthesis.

Shape letters: B batch, P points, K photon slots, H W image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, PhotonInputs, PointInputs, given
from photonfarm.trainer.networks.network import Network, descriptors
from photonfarm.trainer.networks.photon_map import WINDOWS, PhotonLight
from photonfarm.trainer.networks.point_layers import WIDTH, LightTransportLayer
from photonfarm.trainer.runs.settings import NetworkSettings

PHOTON_NUMBERS = 10
"""The features of each photon beside its coordinates: direction 3, normal 3, power 3, bounce 1."""


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
        self.descriptor = descriptors(points, settings)
        self.light_transport = LightTransportLayer(self.coordinate_count, appearance + settings.descriptor)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """f_i, averaged over the points in each pixel, (B, H, W, 64)."""
        points = given(inputs.points)
        return [self.project(self.point_features(points), points.position, points.present, points.seen, inputs)]

    def point_features(self, points: PointInputs) -> Tensor:
        """f_i (B, P, 64) from p_i: current world position, then normal, albedo, emission and learnable descriptor."""
        fixed = torch.cat([self.appearance, self.descriptor], dim=1)
        reference = self.coordinates(self.base) if self.relative else None
        return self.light_transport(self.coordinates(points.position), fixed, points.present, reference)


class LightTransportPhotons(LightTransport):
    """The supplement's network with photons of the current configuration, "Ours (w/ photons)"; the design is ours.

    With `photons = gathered` its inputs include the light gathered from them in windows of the image; and that of the
    widest window, times albedo, is the image that its output is added to. With `transport` a second PointNet of the
    same kind over the photons is projected and averaged like the points. No input depends on the number of photons
    except by its noise: not their power, which is normalised, nor a maximum or mean over them.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        photon_light = PhotonLight(frame, settings.architecture)
        transported = settings.photons == "transport"
        super().__init__(settings, frame, further=WIDTH + (WIDTH if transported else 3 * len(WINDOWS)))
        self.photon_light = photon_light
        self.photon_depth, self.photon_scale = frame.photon_depth, frame.photon_scale
        layer = LightTransportLayer(self.coordinate_count + PHOTON_NUMBERS, 0) if transported else None
        self.photon_transport = layer

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The points' features, and log(1 + gathered light), (B, H, W, 3) each, or the photons' features, 64 wide."""
        found, photons = super().further(inputs), given(inputs.photons)
        if self.photon_transport is None:
            return [*found, *(torch.log1p(radiance) for radiance in self.gathered(inputs))]
        where = photons.position, photons.present, photons.seen
        return [*found, self.project(self.photon_features(photons), *where, inputs)]

    def gathered(self, inputs: Inputs) -> list[Tensor]:
        """The light of all photons by `PhotonLight`, (B, H, W, 3) for each window."""
        return self.photon_light(inputs)

    def known(self, inputs: Inputs, further: list[Tensor]) -> Tensor | float:
        """Albedo times the light of the widest window: the photon map's image of diffuse surfaces."""
        return inputs.albedo * torch.expm1(further[-1]) if self.photon_transport is None else 0.0

    def photon_features(self, photons: PhotonInputs) -> Tensor:
        """The features of photons by their own layer, (B, K, 64), also of empty slots; ValueError without it."""
        if self.photon_transport is None:
            raise ValueError("photons = 'gathered': there is no layer for photons")
        position, power = self.coordinates(photons.position), photons.power * self.photon_scale
        bounce = photons.bounce[..., None] / self.photon_depth
        numbers = torch.cat([position, photons.direction, photons.normal, power, bounce], dim=-1)
        return self.photon_transport(numbers, numbers.new_zeros(numbers.shape[1], 0), photons.present)
