"""A test whether a loss finds the clean image under noisy targets: its gradient, averaged over noise of known mean.

A network that is trained on noisy targets finds the clean image if the mean of the gradient is zero there. If for any
prediction it is also the gradient with the clean target, noise changes only the variance of a step [supplement 3.2,
Lemma 1].

Shape letters: N draws of the noise, B batch, H W image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

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
        found = f"at the clean image its gradient over {DRAWS} noisy targets is 0 to within {self.at_clean:.1f}"
        if not self.is_unbiased:
            return (
                f"at the clean image its mean gradient over {DRAWS} noisy targets is {self.at_clean:.0f} standard "
                f"errors from 0 ({LIMIT:g} are allowed)"
            )
        if self.elsewhere <= LIMIT:
            return f"{found} standard errors, and elsewhere it equals the gradient with the clean target"
        return f"{found} standard errors; elsewhere it is not that with the clean target ({self.elsewhere:.0f})"


def judged(loss: LossFunction) -> Verdict:
    """Test a loss on images of random brightness, whose pixels are dark with rare bright samples; deterministic.

    `loss` takes a prediction (B, H, W, 3) and targets (B, 2, H, W, 3), and returns the mean over the batch, ().
    """
    generator = torch.Generator().manual_seed(0)
    clean = 0.1 + torch.rand(1, SIZE, SIZE, 3, generator=generator)
    at_clean = _away(loss, clean, clean, torch.zeros_like(clean), generator)
    others = (0.5 * clean, 2.0 * clean)
    elsewhere = (_away(loss, at, clean, _gradients(loss, at, _halves(clean))[0], generator) for at in others)
    return Verdict(at_clean, max(elsewhere))


def _away(loss: LossFunction, at: Tensor, clean: Tensor, wanted: Tensor, generator: torch.Generator) -> float:
    """The largest distance of the mean gradient at a prediction from the wanted one, in standard errors."""
    drawn = [_gradients(loss, at, _noisy(clean, generator)) for _ in range(DRAWS // BATCH)]
    gradients = torch.cat(drawn).double()
    error = gradients.std(dim=0) / len(gradients) ** 0.5
    off = (gradients.mean(dim=0) - wanted).abs()
    tiny = 1e-6 * gradients.abs().mean() + 1e-30  # rounding
    return float((off / (error + tiny)).max())


def _gradients(loss: LossFunction, at: Tensor, targets: Tensor) -> Tensor:
    """The gradients with each target, as if it were a batch of its own: (B, H, W, 3)."""
    prediction = at.expand(len(targets), -1, -1, -1).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(prediction, targets), prediction)
    return gradient.detach() * len(targets)


def _noisy(clean: Tensor, generator: torch.Generator) -> Tensor:
    """Targets whose mean is the clean image: (B, 2, H, W, 3), mostly a fifth of it, rarely much more."""
    bright = torch.rand(BATCH, 2, *clean.shape[1:], generator=generator) < RARE
    return torch.where(bright, (1 - 0.2 * (1 - RARE)) / RARE, 0.2) * clean[:, None]


def _halves(clean: Tensor) -> Tensor:
    """The clean image as both halves, (1, 2, H, W, 3)."""
    return clean[:, None].expand(-1, 2, -1, -1, -1)
