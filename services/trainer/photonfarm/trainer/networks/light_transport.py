"""The supplement's network, without and with photons: points → light transport → projection → image synthesis.

Shape letters: B batch, P points, K photon slots, H W image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from photonfarm.shared.errors import SpecError
from photonfarm.trainer.light_transport import WIDTH, LightTransportLayer
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, PhotonInputs, PointInputs, given
from photonfarm.trainer.networks.network import Network, descriptors
from photonfarm.trainer.settings import NetworkSettings

PHOTON_NUMBERS = 10
"""Of each photon, beside its coordinates: direction 3, normal 3, power 3, bounce 1."""


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
        return [self.project(self.point_features(points), points.position, points.visible, points.seen, inputs)]

    def point_features(self, points: PointInputs) -> Tensor:
        """f_i (B, P, 64) from p_i: current world position, then normal, albedo, emission and learnable descriptor."""
        fixed = torch.cat([self.appearance, self.descriptor], dim=1)
        reference = self.coordinates(self.base) if self.relative else None
        return self.light_transport(self.coordinates(points.position), fixed, points.visible, reference)


class LightTransportPhotons(LightTransport):
    """The same, with photons of the current configuration: "Ours (w/ photons)", whose design is ours [method 2].

    A second PointNet of the same kind over the photons, projected and averaged like the points. Nothing that it sees
    depends on how many photons there are: not their power, which is normalised, nor a maximum or mean over them.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        if not frame.photon_paths:
            raise SpecError(
                "network.architecture = 'light_transport_photons': the scene has photons.paths = 0, and none are "
                "stored; set photons.paths in its spec and render it anew, or train 'light_transport'"
            )
        super().__init__(settings, frame, further=2 * WIDTH)
        self.photon_depth, self.photon_scale = frame.photon_depth, frame.photon_scale
        self.photon_transport = LightTransportLayer(self.coordinate_count + PHOTON_NUMBERS, 0)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """Those of the points, then those of the photons, (B, H, W, 64) each."""
        photons = given(inputs.photons)
        features, where = self.photon_features(photons), (photons.position, photons.present, photons.seen)
        return [*super().further(inputs), self.project(features, *where, inputs)]

    def photon_features(self, photons: PhotonInputs) -> Tensor:
        """Features of the photons, (B, K, 64); those of empty slots are never projected."""
        position, power = self.coordinates(photons.position), photons.power * self.photon_scale
        bounce = photons.bounce[..., None] / self.photon_depth
        numbers = torch.cat([position, photons.direction, photons.normal, power, bounce], dim=-1)
        return self.photon_transport(numbers, numbers.new_zeros(numbers.shape[1], 0), photons.present)
