"""The learner: a network and its optimiser, trained a step at a time by one process or several that share batches."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch

from photonfarm.shared.core.errors import IncompleteError
from photonfarm.shared.core.records import BasePointCloud, Geometry
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import build, image_of
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.distributed import SINGLE_PROCESS, TrainingGroup
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.average import WeightAverage
from photonfarm.trainer.training.compiled import compile_network
from photonfarm.trainer.training.losses import loss_of
from photonfarm.trainer.training.optimisers import build_optimiser, rate_at


class DivergedError(IncompleteError):
    """Loss or held-out error are no longer finite, or much worse than before; the same run would diverge again.

    `found` states which, and at which step.
    """

    exit_code = 8

    def __init__(self, found: str) -> None:
        super().__init__(
            f"{found}; training cannot go on. What the run has saved is kept; a smaller learning_rate or a larger "
            "batch may help"
        )


class KnownScene(Protocol):
    """What of a scene is known before any sample; a `Feed` knows it."""

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec."""

    @property
    def geometry(self) -> Geometry:
        """Its triangles."""

    @property
    def cloud(self) -> BasePointCloud:
        """Its base cloud."""


class Learner:
    """The network of a scene, equal in all processes of a group, before and after each step."""

    def __init__(self, scene: KnownScene, settings: TrainSettings, group: TrainingGroup = SINGLE_PROCESS) -> None:
        """Make the untrained network of a scene, on the device of this process."""
        frame = SceneFrame.of(scene.spec, scene.geometry, scene.cloud, settings.network)
        self._settings, self._group = settings, group
        self._device = group.device(settings.device)
        self.network = build(settings.network, frame, settings.seed).to(self._device)
        self._loss, self.verdict = loss_of(settings.loss)  # the loss, and the result of the test of its unbiasedness
        self.optimiser = build_optimiser(self.network.parameters(), settings)
        self.average = WeightAverage(self.network, settings.average) if settings.average else None
        compile_network(self.network, settings.compile, self._device)  # and not the average, copied before
        self.rate_factor = 1.0  # times the schedule; not part of the state below

    @property
    def predicting(self) -> Network:
        """The network that makes predictions: with averaged weights, if there are any."""
        return self.network if self.average is None else self.average.network

    def rate(self, number: int) -> float:
        """The learning rate of step `number`."""
        return self.rate_factor * rate_at(number, self._settings)

    def step(self, number: int, batch: TrainingBatch) -> float:
        """Take an optimiser step on this process' part of a batch [supplement 3.1]; returns the whole batch's loss.

        The loss is the same in all processes. If it is not finite, nothing has changed.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate(number)
        self.optimiser.zero_grad()
        batch = batch.to(self._device).for_training()
        loss = self._loss(image_of(self.network, batch.inputs), batch.target)
        torch.autograd.backward(loss)
        value = self._group.average(list(self.network.parameters()), loss, len(batch.rows))
        if math.isfinite(value):
            self.optimiser.step()
            if self.average is not None:
                self.average.take(self.network)
        return value

    def state(self) -> dict[str, Any]:
        """The weights, their average if there is one, and the optimiser's state, for a checkpoint."""
        state = self.optimiser.state_dict()
        memory = [state["state"].get(place, {}) for place in range(len(list(self.network.parameters())))]
        average = None if self.average is None else self.average.state()
        return {"network": self.network.state_dict(), "average": average, "optimiser_state": memory}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the optimiser keeps its present settings.

        If the state has no average, it begins with the weights, as averaging may be switched on when a run is resumed.
        """
        self.network.load_state_dict(state["network"])
        memory = {place: values for place, values in enumerate(state["optimiser_state"]) if values}
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": memory})
        if self.average is not None:
            self.average.restore(state.get("average") or {"weights": state["network"], "steps": 0})
