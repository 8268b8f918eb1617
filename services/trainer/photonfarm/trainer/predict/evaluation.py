"""Held-out error with the noise removed, and the predictors it is measured against."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.shared.core.errors import IncompleteError
from photonfarm.shared.core.estimate import Estimate, clean_error, clean_error_having_seen_a, group_means, noise_floor
from photonfarm.shared.core.frame_costs import Seconds
from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import F32
from photonfarm.trainer.data.dataset import Batch
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import Inputs, map_tensors
from photonfarm.trainer.networks.network import Network

Predictor = Callable[[Batch], F32]
"""A batch's images, (B, H, W, 3), linear radiance × exposure."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors over held-out samples, in squared exposed radiance per channel.

    Views and passes of one configuration share what is hard about it, so they are averaged first; configurations are
    what is independent.
    """

    error: Estimate  # against the clean image, over configurations
    floor: float  # noise of the target: what the error against it would show on top
    per_sample: NDArray[np.float64]  # (n,) clean error of each
    shown: NDArray[np.float64]  # (n,) the same where light above white counts as white, as a display shows it
    units: tuple[Key, ...]  # (n,) what each is held out by: equal for those of one configuration


WHITE = np.float32(1)
"""Of a display, in exposed radiance."""

NONE_COMPLETE = "none of the samples to measure on is complete at present; wait for the workers"

WARM_ROUNDS, TIMED_ROUNDS = 2, 15
"""Calls of each predictor, all by turns: what else the machine does then is the same for all of them."""


@dataclass(frozen=True, slots=True, eq=False)
class DevicePredictor:
    """A `Predictor` whose images are made of a batch's inputs alone, on a device."""

    images: Callable[[Inputs], Tensor]  # (B, H, W, 3), linear radiance × exposure
    device: torch.device

    @torch.no_grad()
    def __call__(self, batch: Batch) -> F32:
        """A batch's images."""
        images: F32 = self.images(self._there(batch.inputs)).cpu().numpy()
        return images

    def of_its_own(self, inputs: Inputs) -> Inputs:
        """A copy of these inputs on its device, which outlives their batch."""
        return map_tensors(lambda tensor: tensor.to(self.device, copy=True), inputs)

    def _there(self, inputs: Inputs) -> Inputs:
        return map_tensors(lambda tensor: tensor.to(self.device), inputs)

    @torch.no_grad()
    def wall_s(self, inputs: Inputs) -> float:
        """Seconds that the images of these inputs take; they lie on the device, and results are left there."""
        self._wait()
        began = time.perf_counter()
        self.images(inputs)
        self._wait()
        return time.perf_counter() - began

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def by_turns(calls: Sequence[tuple[DevicePredictor, Inputs]]) -> list[Seconds]:
    """What each predictor's images of its inputs take, over `TIMED_ROUNDS` rounds of all; inputs are `of_its_own`."""
    rounds = [[predict.wall_s(inputs) for predict, inputs in calls] for _ in range(WARM_ROUNDS + TIMED_ROUNDS)]
    return [Seconds.of(times) for times in np.array(rounds[WARM_ROUNDS:]).T]


def batches(feed: Feed, rows: Sequence[int], size: int) -> Iterator[Batch]:
    """The rows as batches, read through the feed, in their order; without those that are not complete any more."""
    for start in range(0, len(rows), size):
        feed.ask(rows[start : start + size])
        if (batch := feed.take()).rows:
            yield batch


def network_predictor(network: Network) -> DevicePredictor:
    """The network's images, made where its parameters are."""
    return DevicePredictor(network, next(network.parameters()).device)


def mean_colour(found: Iterator[Batch]) -> F32:
    """The mean exposed colour over samples and pixels, (3,): what one predicts who knows nothing of the view."""
    means = [batch.target.double().mean(dim=(1, 2, 3)).numpy() for batch in found]
    colour: F32 = np.concatenate(means).mean(axis=0).astype(np.float32)
    return colour


def constant_predictor(colour: F32) -> Predictor:
    """The same colour everywhere."""
    return lambda batch: np.broadcast_to(colour, batch.inputs.albedo.shape)


def error_of(batch: Batch) -> Callable[[F32, F32, F32], float]:
    """What takes the noise out of the error of a prediction for this batch, given A and B: by whether it has seen A."""
    return clean_error if batch.inputs.noisy is None else clean_error_having_seen_a


def _shown(error: Callable[[F32, F32, F32], float], *images: F32) -> float:
    """The error of images whose light above white counts as white.

    It is not unbiased, as noise above white is cut. But a lamp in view, hundreds of times brighter than what it lights,
    is most of the error otherwise.
    """
    prediction, half_a, half_b = (np.minimum(image, WHITE) for image in images)
    return error(prediction, half_a, half_b)


def measure(predict: Predictor, found: Iterator[Batch]) -> HeldOut:
    """The predictor's error over samples: mean (f − A)(f − B), and the noise floor mean (A − B)²/4 [estimate].

    Of a predictor that is given noisy colour, which is A's, mean f² − 2fB + AB.

    Raises IncompleteError if there is no sample.
    """
    errors, shown, floors = [], [], []
    units: list[Key] = []
    for batch in found:
        units.extend(batch.units)
        error = error_of(batch)
        for image, (half_a, half_b) in zip(predict(batch), batch.target.numpy(), strict=True):
            errors.append(error(image, half_a, half_b))
            shown.append(_shown(error, image, half_a, half_b))
            floors.append(noise_floor(half_a, half_b))
    if not errors:
        raise IncompleteError(NONE_COMPLETE)
    per_sample = np.array(errors)
    floor = float(np.mean(group_means(np.array(floors), units)))
    return HeldOut(Estimate.of(group_means(per_sample, units)), floor, per_sample, np.array(shown), tuple(units))
