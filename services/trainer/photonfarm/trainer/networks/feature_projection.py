"""The baseline with its scene's points, but without light transport between them.

Shape letters: B batch, P points, H W image.
"""

from __future__ import annotations

from torch import Tensor

from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, given
from photonfarm.trainer.networks.network import Network, descriptors
from photonfarm.trainer.runs.settings import NetworkSettings


class FeatureProjection(Network):
    """Each point's learnable descriptor, projected unchanged [supplement Table 1, "Feature projection"].

    A descriptor moves with its point, and is the same in every configuration.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=settings.descriptor)
        self.descriptor = descriptors(len(frame.appearance), settings)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The descriptors, averaged over the points in each pixel, (B, H, W, descriptor)."""
        points = given(inputs.points)
        features = self.descriptor.expand(len(points.position), -1, -1)
        return [self.project(features, points.position, points.present, points.seen, inputs)]
