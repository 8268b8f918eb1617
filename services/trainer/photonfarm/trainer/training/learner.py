"""The learner: a network and its optimiser, trained a step at a time by one process or several that share batches.

With the optimisers that the supplement compared, and the schedules of their rate [supplement 3.1]. The average of a
network's weights over its training makes its predictions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.scene.poor_views import are_near
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import build, find_kind, predict_image
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.devices import Ranks, compute_deterministically
from photonfarm.trainer.runs.settings import Compilation, TrainSettings
from photonfarm.trainer.training.losses import RELATIVE_EPSILON, find_loss


def build_optimiser(
    weights: Iterable[nn.Parameter] | list[dict[str, Any]], settings: TrainSettings
) -> torch.optim.Optimizer:
    """Adam or RMSprop over these weights or groups, without weight decay, momentum of RMSprop or gradient clipping.

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


WIDE = 144
"""The inputs of a layer from which on "scaled" lowers its rate: those of a 3×3 convolution of 16 channels."""


def group_weights(network: nn.Module, settings: TrainSettings) -> list[dict[str, Any]]:
    """The weights of a network in groups, as optimisers take them, each with the `factor` on its rate.

    Adam moves every weight of a layer by about the rate, whatever the gradient, and all of them for one purpose. So a
    step changes what the layer puts out by the rate times the number of its inputs, and a rate that is good for 16
    channels lets 512 channels diverge. By `layer_rates = "scaled"` the factor is 144 / inputs, at most 1, so that
    one rate is good for all widths (Yang et al., Tensor Programs V, 2021, 2, for Adam). The factor is a constant, and
    biases nothing.
    """
    factors: dict[Tensor, float] = dict.fromkeys(network.parameters(), 1.0)
    if settings.layer_rates == "scaled":
        for layer in network.modules():
            if isinstance(layer, nn.Linear | nn.Conv2d):
                factors[layer.weight] = min(1.0, WIDE / layer.weight[0].numel())
    groups: dict[float, list[Tensor]] = {}
    for weight, factor in factors.items():
        groups.setdefault(factor, []).append(weight)
    return [{"params": weights, "factor": factor} for factor, weights in groups.items()]


def compute_rate(step: int, settings: TrainSettings, last: int | None = None) -> float:
    """The learning rate of a step, by the schedule of the settings; of a run that ends at step `last`, if before.

    "epochs": learning_rate × decay^epoch, where an epoch is a number of samples drawn [supplement 3.1]. "cosine" is
    ours: linearly up over the `warm_up` (Goyal et al., Accurate, Large Minibatch SGD, 2017, 2.2), then by
    (1 + cos πx) / 2 down to 0 at `max_steps` (Loshchilov and Hutter, SGDR, 2017, 5, without restarts).
    """
    if settings.schedule == "epochs":
        return settings.learning_rate * settings.decay ** (step * settings.batch // settings.epoch_samples)
    end = settings.max_steps if last is None else min(last, settings.max_steps)
    rising = int(settings.warm_up * end)
    if step < rising:
        return settings.learning_rate * ((step + 1) / rising)
    fallen = min((step - rising) / max(end - rising, 1), 1.0)
    return settings.learning_rate * ((1 + math.cos(math.pi * fallen)) / 2)


MEMORY = 0.995
"""The decay of the running mean of what a loss exceeds its floor by: 200 steps."""


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
        torch._foreach_lerp_(list(self.network.parameters()), list(network.parameters()), 1 - decay)
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
    mode = "reduce-overhead" if how == "graphs" else "default"
    (network.image_synthesis if isinstance(network, Network) else network).compile(mode=mode, dynamic=False)


@contextmanager
def name_compile_errors(how: Compilation) -> Iterator[None]:
    """Turn a failure to compile into a SpecError of one sentence."""
    try:
        yield
    except Exception as error:
        if how == "off":
            raise
        from torch._dynamo.exc import TorchDynamoException  # which is slow to load

        if not isinstance(error, TorchDynamoException):
            raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SpecError(
            f"compile = {how!r}: torch cannot compile the network on this machine: {reason}. It needs a C++ compiler, "
            "and on CUDA Triton; install these, or train with compile = off"
        ) from error


class DivergedError(IncompleteError):
    """Loss or held-out error are no longer finite, or much worse than before; the same run would diverge again.

    `fault` states which, and at which step.
    """

    exit_code = 8

    def __init__(self, fault: str) -> None:
        super().__init__(
            f"{fault}; training cannot go on. What the run has saved is kept; a smaller learning_rate or a larger "
            "batch may help"
        )


class Learner:
    """The network of a scene, equal in all processes of a group, before and after each step."""

    def __init__(self, frame: SceneFrame, settings: TrainSettings, ranks: Ranks) -> None:
        """Make the untrained network of a scene, on the device of this process."""
        self._settings, self._ranks, self._frame = settings, ranks, frame
        self._device = ranks.device(settings.device)
        if settings.deterministic:
            compute_deterministically(self._device)
        self.network = self.make_untrained()
        self._loss, self.verdict = find_loss(settings.loss)  # the loss, and the result of the test of its unbiasedness
        self.optimiser = build_optimiser(group_weights(self.network, settings), settings)
        self.average = WeightAverage(self.network, settings.average) if settings.average else None
        compile_network(self.network, settings.compile, self._device)  # and not the average, copied before
        self.rate_factor = 1.0  # times the schedule; not part of the state below
        self.last_step: int | None = None  # at which the data end the run; not part of the state either
        self._sees_halves = find_kind(settings.network.architecture).needs.kept == 1  # and all of their pixels
        self._poor: Tensor | None = None  # (4,) poor samples, all, squared gradient of steps with such, of all
        self.excess: Tensor | None = None  # (), of the loss over that of the clean image, in the mean of the last steps

    @property
    def predicting(self) -> Network:
        """The network that makes predictions: with averaged weights, if there are any."""
        return self.network if self.average is None else self.average.network

    def rate(self, number: int) -> float:
        """The learning rate of step `number`, of layers whose factor is 1."""
        return self.rate_factor * compute_rate(number, self._settings, self.last_step)

    def step(self, number: int, batch: TrainingBatch) -> Tensor:
        """Take an optimiser step on this process' part of a batch [supplement 3.1]; returns the whole batch's loss, ().

        The loss is the same in all processes, and lies on the device: no step waits for a card.
        """
        for options in self.optimiser.param_groups:
            options["lr"] = self.rate(number) * options["factor"]
        self.optimiser.zero_grad()
        given = batch.to(self._device)
        batch = given.for_training()
        image = predict_image(self.network, batch.inputs)
        loss = self._loss(image, batch.target)
        self._note_excess(number, image.detach(), batch)
        torch.autograd.backward(loss)
        mean_loss = self._ranks.average_gradients(list(self.network.parameters()), loss, len(batch.rows))
        self._note_gradient(given)
        self.optimiser.step()
        if self.average is not None:
            self.average.take(self.network)
        return mean_loss

    def make_untrained(self) -> Network:
        """Make the network as it is before any step."""
        return build(self._settings.network, self._frame, self._settings.seed).to(self._device)

    @torch.no_grad()
    def compute_loss(self, network: Network, batch: TrainingBatch) -> Tensor:
        """The loss of a network on the whole batch, (), of which a part is here; as `step` returns it."""
        batch = batch.to(self._device).for_training()
        loss = self._loss(predict_image(network, batch.inputs), batch.target)
        return self._ranks.average(loss.reshape(1), len(batch.rows))[0]

    @torch.no_grad()
    def measure_excess(self, image: Tensor, batch: TrainingBatch) -> Tensor | None:
        """The loss of images less its floor, (), which no network but by heart gets below; None if half A is not whole.

        The clean image's loss is noise alone, mean (B − I)². For halves A and B that is mean (A − B)² / 2, with the
        loss's own weights; A may be the input. Where both are targets, what is left is mean (f − A)(f − B), whose mean
        is that of (f − I)²; it has the weights of the linear loss, or of the relative one.
        """
        noisy, target = batch.inputs.noisy, batch.target
        if noisy is None:
            brightness = image.mean(dim=-1, keepdim=True)
            weight = 1 if self._settings.loss == "linear" else 1 / (brightness**2 + RELATIVE_EPSILON)
            return torch.mean(weight * (image - target[:, 0]) * (image - target[:, 1]))
        if not self._sees_halves:
            return None
        apart = (noisy.colour[:, None] - target[:, -1:]) / math.sqrt(2)
        return self._loss(image, target[:, -1:]) - self._loss(image, image[:, None] + apart)

    def _note_excess(self, number: int, image: Tensor, batch: TrainingBatch) -> None:
        """Add a step to the running mean of the excess."""
        if (excess := self.measure_excess(image, batch)) is not None:
            decay = min(MEMORY, (1 + number) / (10 + number))
            self.excess = excess if self.excess is None else torch.lerp(excess, self.excess, decay)

    @torch.no_grad()
    def _note_gradient(self, batch: TrainingBatch) -> None:
        """Count the samples that are black or near, and the squared gradient of the steps that have one."""
        depth, target = batch.inputs.depth, batch.target
        poor = are_near(self._frame.hand, depth) | (target == 0).all(-1).all(-1).all(-1).all(-1)
        gradients = [weight.grad for weight in self.network.parameters() if weight.grad is not None]
        squared = torch.stack(torch._foreach_norm(gradients)).square().sum()
        counts = torch.stack([poor.float().sum(), torch.ones_like(squared) * len(poor), squared * poor.any(), squared])
        self._poor = counts if self._poor is None else self._poor + counts

    def take_poor(self) -> dict[str, float]:
        """The shares of black or near views among samples, and in the squared gradient, since the last call."""
        poor, samples, of_poor, squared = [0.0, 1, 0, 1] if self._poor is None else self._poor.tolist()
        self._poor = None
        is_known = poor > 0 and 0 < squared < math.inf  # not so after a step whose gradient was not finite
        return {"samples": poor / samples, "gradient": of_poor / squared} if is_known else {}

    def describe_excess(self, steps_of_each: float) -> dict[str, float]:
        """The excess of the last steps, and of a network of halves the rounds over them."""
        rounds = {"rounds": round(steps_of_each * self._settings.batch, 2)} if self._sees_halves else {}
        return {} if self.excess is None else {**rounds, "excess": float(self.excess)}

    def begin_with(self, weights: dict[str, Tensor]) -> None:
        """Take weights before the first step."""
        self.network.load_state_dict(weights)
        if self.average is not None:
            self.average.restore({"weights": weights, "steps": 0})

    def state(self) -> dict[str, Any]:
        """The weights, their average if there is one, and the optimiser's state, for a checkpoint."""
        memory = [dict(self.optimiser.state.get(weight, {})) for weight in self.network.parameters()]
        average = None if self.average is None else self.average.state()
        weights = {"network": self.network.state_dict(), "average": average, "optimiser_state": memory}
        return weights if self.excess is None else {**weights, "excess": self.excess}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; the optimiser keeps its present settings.

        If the state has no average, it begins with the weights, as averaging may be switched on when a run is resumed.
        """
        self.network.load_state_dict(state["network"])
        self.excess = None if state.get("excess") is None else state["excess"].to(self._device)
        self.optimiser.state.clear()
        for weight, memory in zip(self.network.parameters(), state["optimiser_state"], strict=True):
            if memory:
                self.optimiser.state[weight] = {name: value.to(weight.device) for name, value in memory.items()}
        if self.average is not None:
            self.average.restore(state.get("average") or {"weights": state["network"], "steps": 0})
