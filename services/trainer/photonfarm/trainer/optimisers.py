"""The optimisers of the supplement's grid search, and the schedule of their rate [supplement 3.1]."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn

from photonfarm.trainer.settings import TrainSettings


def build_optimiser(weights: Iterable[nn.Parameter], settings: TrainSettings) -> torch.optim.Optimizer:
    """Adam or RMSprop over these weights, without weight decay, momentum of RMSprop or gradient clipping.

    Both divide each weight's step by the root of a running mean of its squared gradients, and so both darken where
    bright targets are rarer than that mean is long (bench/firefly.py).
    """
    if settings.optimiser == "rmsprop":
        return torch.optim.RMSprop(weights, lr=settings.learning_rate, alpha=settings.alpha)
    return torch.optim.Adam(
        weights,
        lr=settings.learning_rate,
        betas=(settings.beta1, settings.beta2),
        fused=True,  # one pass over the weights; half the time of the default on a CPU
    )


def rate_at(step: int, settings: TrainSettings) -> float:
    """The learning rate of a step: learning_rate × decay^epoch, where an epoch is so many samples drawn."""
    return settings.learning_rate * settings.decay ** (step * settings.batch // settings.epoch_samples)
