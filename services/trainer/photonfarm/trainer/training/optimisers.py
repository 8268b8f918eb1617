"""The optimisers that the supplement compared, and the schedules of their rate [supplement 3.1].

The average of a network's weights over its training makes its predictions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import nn

from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import TrainSettings


def build_optimiser(weights: Iterable[nn.Parameter], settings: TrainSettings) -> torch.optim.Optimizer:
    """Adam or RMSprop over these weights, without weight decay, momentum of RMSprop or gradient clipping.

    Both divide each weight's step by the root of a running mean of its squared gradients, and so both darken pixels
    whose bright targets are rarer than the length of that mean (docs/results/networks.md).
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


class WeightAverage:
    """A network whose weights are the running mean of another's, which is trained."""

    def __init__(self, network: Network, decay: float) -> None:
        """Begin with the network's present weights."""
        self.network = copy.deepcopy(network).requires_grad_(False).eval()
        self._decay = decay
        self._steps = 0

    @torch.no_grad()
    def take(self, network: Network) -> None:
        """Add the weights after a step: mean ← d · mean + (1 − d) · weights, d = min(decay, (1 + n) / (10 + n)).

        n is the number of steps added before: so the first weights, which are random, are soon forgotten. That is the
        correction of tf.train.ExponentialMovingAverage, with its num_updates (Abadi et al., TensorFlow, 2016). Buffers,
        such as the running means of batch normalisation, are copied.
        """
        decay = min(self._decay, (1 + self._steps) / (10 + self._steps))
        for mean, weight in zip(self.network.parameters(), network.parameters(), strict=True):
            mean.lerp_(weight, 1 - decay)
        for kept, buffer in zip(self.network.buffers(), network.buffers(), strict=True):
            kept.copy_(buffer)
        self._steps += 1

    def state(self) -> dict[str, Any]:
        """The mean weights, and the number of steps in them."""
        return {"weights": self.network.state_dict(), "steps": self._steps}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self.network.load_state_dict(state["weights"])
        self._steps = state["steps"]
