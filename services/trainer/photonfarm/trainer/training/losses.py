"""The losses. All are unbiased under noisy targets, and every change here must keep them so.

Nothing may be clipped, compressed, or weighted by its own noise: each moves the minimum away from the clean image.
Shape letters: B batch, H W image.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs import user_code
from photonfarm.trainer.training.unbiasedness import Verdict, judged

RELATIVE_EPSILON = 0.05
"""The ε of the relative loss, squared exposed radiance: the display's middle grey, 0.5^2.2 ≈ 0.22.

Darker pixels count about as in the linear loss; with the white's 1 instead, the edges of lamps still outweighed the
effect of their light on a room.
"""


def linear_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean squared error in exposed linear radiance against both half-estimates: (B, H, W, 3), (B, 2, H, W, 3) → ().

    Its gradient is that of the error against (A + B)/2, and so in expectation that of the error against the clean image
    [supplement Lemma 1]. Nothing may be clipped, compressed or weighted by the target here: each would bias it.
    """
    return torch.mean((prediction[:, None] - target) ** 2)


def relative_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """The squared error relative to the brightness of the prediction, through which no gradient passes.

    Each pixel's weight 1 / (mean² + ε) depends on the network and not on the target, so the noise cannot bias it: in
    expectation the gradient is the one with the clean image and the same weights (Lehtinen et al., Noise2Noise, 2018;
    detached as in Müller et al., Real-time Neural Radiance Caching, 2021). A lamp in view, hundreds of times brighter
    than the surfaces it lights, no longer outweighs everything else. Ours; the supplement trained with another loss.
    """
    brightness = prediction.detach().mean(dim=-1, keepdim=True)
    return torch.mean((prediction[:, None] - target) ** 2 / (brightness**2 + RELATIVE_EPSILON)[:, None])


def paired_loss(prediction: Tensor, target: Tensor, weighting: Tensor | None = None) -> Tensor:
    """The relative error of each half (B, 2, H, W, 3), with weights from the prediction and the other half.

    Where the prediction is far too dark, as beside lamps at first, the weight of the relative loss is far too large,
    and a few such pixels dominate the gradient. The other half shows that they are bright. Its noise is independent of
    this half's, so E w(B) (f − A) = E w(B) · (f − I), which is zero for the clean image. But the weight of a pixel
    depends on the noise. So a network that cannot be right everywhere is right where the noise made weights large.

    The loss is our own. `weighting` has the halves that give the weights; without it the target does. Raises ValueError
    unless it has two halves.
    """
    weighting = target if weighting is None else weighting
    if weighting.shape[1] != 2:
        raise ValueError(
            f"paired_loss: {weighting.shape[1]} half-estimates are given; give 2, as each one weights the other"
        )
    prediction = prediction[:, None]
    brightness, of_other = (image.mean(dim=-1, keepdim=True) for image in (prediction.detach(), weighting.flip(1)))
    return torch.mean((prediction - target) ** 2 / (brightness**2 + of_other**2 + RELATIVE_EPSILON))


LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "linear": linear_loss,
    "relative": relative_loss,
    "paired": paired_loss,
}


def loss_of(name: str) -> tuple[Callable[[Tensor, Tensor], Tensor], Verdict | None]:
    """The loss of a name; for a user's own (`MODULE:NAME`) also the result of the test of its unbiasedness.

    A loss takes a prediction (B, H, W, 3) and two targets (B, 2, H, W, 3), and returns the mean over the batch, ().
    Raises SpecError if it cannot be loaded, and if it biases.
    """
    if name in LOSSES:
        return LOSSES[name], None
    loss = user_code.load("loss", name)
    verdict = judged(loss)
    if not verdict.is_unbiased:
        raise SpecError(f"loss = {name!r}: is refused because noisy targets bias it: {verdict}")
    return loss, verdict
