"""What learns: a network and its optimiser, a step at a time, by one process or by several that share each batch."""

from __future__ import annotations

import math
from typing import Any

import torch

from photonfarm.shared.errors import IncompleteError
from photonfarm.trainer.dataset import Batch
from photonfarm.trainer.distributed import ALONE, Group
from photonfarm.trainer.feed import Feed
from photonfarm.trainer.losses import LOSSES
from photonfarm.trainer.networks import build
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.optimisers import build_optimiser, rate_at
from photonfarm.trainer.settings import TrainSettings


class DivergedError(IncompleteError):
    """The loss is no longer finite; the same run would come to the same step."""

    exit_code = 8


class Learner:
    """The network of a scene, equal in all processes of a group, before and after each step."""

    def __init__(self, feed: Feed, settings: TrainSettings, group: Group = ALONE) -> None:
        """The untrained network of the feed's scene, on the device of this process."""
        frame = SceneFrame.of(feed.spec, feed.geometry, feed.cloud, settings.network)
        self._settings, self._group = settings, group
        self._device = group.device(settings.device)
        self.network = build(settings.network, frame, settings.seed).to(self._device)
        self.optimiser = build_optimiser(self.network.parameters(), settings)

    def step(self, number: int, batch: Batch) -> float:
        """Step `number` of the optimiser on this process' part of a batch [supplement 3.1]; returns the batch's loss.

        Raises DivergedError, in all processes, if that is not finite; the weights are then as they were.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = rate_at(number, self._settings)
        self.optimiser.zero_grad()
        loss = torch.zeros((), device=self._device)
        if batch.rows:  # of a part, all may have been taken back
            batch = batch.to(self._device).for_training()
            loss = LOSSES[self._settings.loss](self.network(batch.inputs), batch.target)
            torch.autograd.backward(loss)
        value = self._group.average(list(self.network.parameters()), loss, len(batch.rows))
        if not math.isfinite(value):
            raise DivergedError(
                f"step {number}: the loss is {value} on rows {list(batch.rows)}; training cannot go on. What "
                "the run has saved is kept; a smaller learning_rate or a larger batch may help"
            )
        self.optimiser.step()
        return value

    def state(self) -> dict[str, Any]:
        """Weights and the optimiser's memory, for a checkpoint."""
        state = self.optimiser.state_dict()
        memory = [state["state"].get(place, {}) for place in range(len(list(self.network.parameters())))]
        return {"network": self.network.state_dict(), "optimiser_state": memory}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the optimiser's own settings stay those of now."""
        self.network.load_state_dict(state["network"])
        memory = {place: values for place, values in enumerate(state["optimiser_state"]) if values}
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": memory})
