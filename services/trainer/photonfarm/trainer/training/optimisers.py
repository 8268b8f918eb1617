"""The optimisers that the supplement compared, and the schedules of their rate [supplement 3.1]."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import nn

from photonfarm.trainer.runs.settings import TrainSettings


def build_optimiser(weights: Iterable[nn.Parameter], settings: TrainSettings) -> torch.optim.Optimizer:
    """Adam or RMSprop over these weights, without weight decay, momentum of RMSprop or gradient clipping.

    Both divide each weight's step by the root of a running mean of its squared gradients, and so both darken pixels
    whose bright targets are rarer than the length of that mean (bench/trainer/firefly.py).
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
    """The learning rate of a step, by the schedule of the settings.

    "epochs": learning_rate × decay^epoch, where an epoch is a number of samples drawn [supplement 3.1]. "cosine" is
    ours.
    """
    if settings.schedule == "cosine":
        return settings.learning_rate * _cosine(step, settings.max_steps, int(settings.warm_up * settings.max_steps))
    return settings.learning_rate * settings.decay ** (step * settings.batch // settings.epoch_samples)


def _cosine(step: int, steps: int, rising: int) -> float:
    """The share of the rate: linearly up to 1 over `rising` steps, then (1 + cos πx) / 2 down to 0 at `steps`.

    The first part is of Goyal et al., Accurate, Large Minibatch SGD, 2017 (2.2); the second of Loshchilov and Hutter,
    SGDR, 2017 (5), without restarts.
    """
    if step < rising:
        return (step + 1) / rising
    return (1 + math.cos(math.pi * min((step - rising) / (steps - rising), 1.0))) / 2
