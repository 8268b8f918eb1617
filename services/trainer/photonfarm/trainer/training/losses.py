"""The losses, and the test that each finds the clean image under noisy targets.

All losses are unbiased, and every change here must keep them so. Nothing may be clipped, compressed, or weighted by its
own noise: each moves the minimum away from the clean image.

The test averages a loss's gradient over noise of known mean. A network finds the clean image if the mean gradient is
zero at that image. If for any prediction it is also the gradient with the clean target, noise changes only the variance
of a step [supplement 3.2, Lemma 1].

Shape letters: N draws of the noise, B batch, H W image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs import user_code

LossFunction = Callable[[Tensor, Tensor], Tensor]

DRAWS = 8192
"""The targets of the test: a bias of 6 % of a gradient's standard deviation is then five standard errors."""

BATCH = 64
SIZE = 4  # px
LIMIT = 5.5
"""The limit in standard errors, which one of an unbiased loss's 48 gradients exceeds with a probability of 2e-6."""

RARE = 0.125
"""The probability of the bright value: like noise of light that is hard to find, dark with rare bright samples."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of the test of a loss."""

    at_clean: float  # largest mean gradient at the clean image, in standard errors
    elsewhere: float  # largest difference to the gradient with the clean target, likewise, at other predictions

    @property
    def is_unbiased(self) -> bool:
        """Whether noisy targets lead to the clean image."""
        return self.at_clean <= LIMIT

    def __str__(self) -> str:
        sentence = f"at the clean image its gradient over {DRAWS} noisy targets is 0 to within {self.at_clean:.1f}"
        if not self.is_unbiased:
            return (
                f"at the clean image its mean gradient over {DRAWS} noisy targets is {self.at_clean:.0f} standard "
                f"errors from 0 ({LIMIT:g} are allowed)"
            )
        if self.elsewhere <= LIMIT:
            return f"{sentence} standard errors, and elsewhere it equals the gradient with the clean target"
        return f"{sentence} standard errors; elsewhere it is not that with the clean target ({self.elsewhere:.0f})"


def judge(loss: LossFunction) -> Verdict:
    """Test a loss on images of random brightness, whose pixels are dark with rare bright samples; deterministic.

    `loss` takes a prediction (B, H, W, 3) and targets (B, 2, H, W, 3), or (B, 1, …) with noisy colour. It
    returns the mean over the batch, ().
    """
    generator = torch.Generator().manual_seed(0)
    clean = 0.1 + torch.rand(1, SIZE, SIZE, 3, generator=generator)
    at_clean = _measure_distance(loss, clean, clean, torch.zeros_like(clean), generator)
    halves = clean[:, None].expand(-1, 2, -1, -1, -1)  # the clean image as both, (1, 2, H, W, 3)
    elsewhere = (
        _measure_distance(loss, at, clean, _compute_gradients(loss, at, halves)[0], generator)
        for at in (0.5 * clean, 2.0 * clean)
    )
    return Verdict(at_clean, max(elsewhere))


def _measure_distance(
    loss: LossFunction, at: Tensor, clean: Tensor, wanted: Tensor, generator: torch.Generator
) -> float:
    """The largest distance of the mean gradient at a prediction from the wanted one, in standard errors."""
    drawn = [_compute_gradients(loss, at, _draw_noisy(clean, generator)) for _ in range(DRAWS // BATCH)]
    gradients = torch.cat(drawn).double()
    error = gradients.std(dim=0) / len(gradients) ** 0.5
    off = (gradients.mean(dim=0) - wanted).abs()
    tiny = 1e-6 * gradients.abs().mean() + 1e-30  # rounding
    return float((off / (error + tiny)).max())


def _compute_gradients(loss: LossFunction, at: Tensor, targets: Tensor) -> Tensor:
    """The gradients with each target, as if it were a batch of its own: (B, H, W, 3)."""
    prediction = at.expand(len(targets), -1, -1, -1).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(prediction, targets), prediction)
    return gradient.detach() * len(targets)


def _draw_noisy(clean: Tensor, generator: torch.Generator) -> Tensor:
    """Targets whose mean is the clean image: (B, 2, H, W, 3), mostly a fifth of it, rarely much more."""
    bright = torch.rand(BATCH, 2, *clean.shape[1:], generator=generator) < RARE
    return torch.where(bright, (1 - 0.2 * (1 - RARE)) / RARE, 0.2) * clean[:, None]


RELATIVE_EPSILON = 0.05
"""The ε of the relative loss, in squared exposed radiance: 0.22², where 0.5^2.2 ≈ 0.22 is the display's middle grey.

Darker pixels count about as in the linear loss; with ε = 1, the square of white, the edges of lamps still outweighed
the effect of their light on a room.
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
    this half's, so E w(B) (f − A) = E w(B) · (f − I), which is zero at f = I, the clean image. But the weight of a
    pixel depends on the noise: a network that cannot be right everywhere is right where noise made weights large.

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


def find_loss(name: str) -> tuple[Callable[[Tensor, Tensor], Tensor], Verdict | None]:
    """The loss of a name; for a user's own (`MODULE:NAME`) also the result of the test of its unbiasedness.

    A loss takes a prediction (B, H, W, 3) and two targets (B, 2, H, W, 3), or one of noisy colour (B, 1, H, W, 3), and
    returns the mean over the batch, ().
    Raises SpecError if it cannot be loaded, and if it biases.
    """
    if name in LOSSES:
        return LOSSES[name], None
    loss = user_code.load("loss", name)
    verdict = judge(loss)
    if not verdict.is_unbiased:
        raise SpecError(f"loss = {name!r}: is refused because noisy targets bias it: {verdict}")
    return loss, verdict
