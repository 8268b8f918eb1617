"""The baseline that is given part of a rendered image: `denoise(1/k)` [supplement 4].

Shape letters: H W image.
"""

from __future__ import annotations

from torch import Tensor

from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Inputs, given
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import NetworkSettings

SHARE = 2
"""A light U-Net is half as wide, so about a quarter of the work. Published times fit 1.50 s / k + 0.005 s, where the
full one takes 0.019 s [method 2, 4]."""


class Denoiser(Network):
    """A light U-Net over sparse noisy colour, the mask of what was kept, and the image-space channels.

    It is trained on pairs of independent noisy halves (Lehtinen et al., Noise2Noise, 2018): what it sees is never in
    its target. The colour is linear; how much of it is seen does not show in the network, only in its weights.
    """

    def __init__(self, settings: NetworkSettings, frame: SceneFrame) -> None:
        super().__init__(settings, frame, further=3 + 1, share=SHARE)

    def further(self, inputs: Inputs) -> list[Tensor]:
        """Noisy colour, zero where not kept, and the mask, (B, H, W, 3) and (B, H, W, 1)."""
        noisy = given(inputs.noisy)
        return [noisy.colour, noisy.kept[..., None].to(noisy.colour)]
