"""The learner: a network and its optimiser, trained a step at a time by one process or several that share batches.

With the optimisers that the supplement compared, and the schedules of their rate [supplement 3.1]. The average of a
network's weights over its training makes its predictions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from torch import nn

from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import build, predict_image
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.devices import SINGLE_PROCESS, TrainingGroup
from photonfarm.trainer.runs.settings import Compilation, TrainSettings
from photonfarm.trainer.training.losses import find_loss


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


def compute_rate(step: int, settings: TrainSettings) -> float:
    """The learning rate of a step, by the schedule of the settings.

    "epochs": learning_rate × decay^epoch, where an epoch is a number of samples drawn [supplement 3.1]. "cosine" is
    ours.
    """
    if settings.schedule == "cosine":
        return settings.learning_rate * _anneal(step, settings.max_steps, int(settings.warm_up * settings.max_steps))
    return settings.learning_rate * settings.decay ** (step * settings.batch // settings.epoch_samples)


def _anneal(step: int, steps: int, rising: int) -> float:
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


MODES = {"on": "default", "graphs": "reduce-overhead"}
"""torch's name of each way to compile; the second records CUDA graphs."""


def compile_network(network: nn.Module, how: Compilation, device: torch.device) -> None:
    """Have torch compile a network's U-Net when it is first used; all of a network that is no `Network`.

    The U-Net is most of the work, and its shapes are those of the image; how many points land in an image differs by
    the view, and would be compiled again and again. Weights keep their names; values change by rounding alone. Raises
    SpecError for CUDA graphs on another device.
    """
    if how == "off":
        return
    if how == "graphs" and device.type != "cuda":
        raise SpecError(f"compile = 'graphs': CUDA graphs need a CUDA device, and this run is on {device}; give on")
    (network.image_synthesis if isinstance(network, Network) else network).compile(mode=MODES[how], dynamic=False)


@contextmanager
def name_compile_errors(how: Compilation) -> Iterator[None]:
    """Turn a failure to compile into a SpecError of one sentence."""
    try:
        yield
    except Exception as error:
        if how == "off" or not isinstance(error, _list_compiler_errors()):
            raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SpecError(
            f"compile = {how!r}: torch cannot compile the network on this machine: {reason}. It needs a C++ compiler, "
            "and on CUDA Triton; install these, or train with compile = off"
        ) from error


def _list_compiler_errors() -> tuple[type[Exception], ...]:
    """The errors of torch's compiler, which is imported here only where it has been used."""
    from torch._dynamo.exc import TorchDynamoException

    return (TorchDynamoException,)


class DivergedError(IncompleteError):
    """Loss or held-out error are no longer finite, or much worse than before; the same run would diverge again.

    `found` states which, and at which step.
    """

    exit_code = 8

    def __init__(self, fault: str) -> None:
        super().__init__(
            f"{fault}; training cannot go on. What the run has saved is kept; a smaller learning_rate or a larger "
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
        self._loss, self.verdict = find_loss(settings.loss)  # the loss, and the result of the test of its unbiasedness
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
        return self.rate_factor * compute_rate(number, self._settings)

    def step(self, number: int, batch: TrainingBatch) -> float:
        """Take an optimiser step on this process' part of a batch [supplement 3.1]; returns the whole batch's loss.

        The loss is the same in all processes. If it is not finite, nothing has changed.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate(number)
        self.optimiser.zero_grad()
        batch = batch.to(self._device).for_training()
        loss = self._loss(predict_image(self.network, batch.inputs), batch.target)
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
