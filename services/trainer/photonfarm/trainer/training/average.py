"""The average of a network's weights over its training, which makes its predictions."""

from __future__ import annotations

import copy
from typing import Any

import torch

from photonfarm.trainer.networks.network import Network


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
