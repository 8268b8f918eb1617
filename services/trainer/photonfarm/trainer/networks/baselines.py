"""Baselines without light transport between points [supplement 4].

`cnn` has no inputs but the image-space buffers, `denoise(1/k)` has part of a rendered image, and `feature_projection`
has its scene's points.

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


class Cnn(Network):
    """Image synthesis from the image-space channels alone [supplement Table 1, "CNN only"]."""


SHARE = 2
"""The divisor of a light U-Net's width: half as wide, it has about a quarter of the work.

Published times fit 1.50 s / k + 0.005 s, where the full U-Net takes 0.019 s [method 2, 4].
"""


class Denoiser(Network):
    """A light U-Net over sparse noisy colour, the mask of the kept pixels, and the image-space channels.

    It is trained on pairs of independent noisy halves (Lehtinen et al., Noise2Noise, 2018): its input is never in its
    target. The colour is linear; the share of kept pixels affects only its weights, not its structure.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=3 + 1, share=SHARE)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """The noisy colour, zero where not kept, and the mask, (B, H, W, 3) and (B, H, W, 1)."""
        noisy = given(inputs.noisy)
        return [noisy.colour, noisy.kept[..., None].to(noisy.colour)]
