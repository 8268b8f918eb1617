"""Held-out error with the noise removed, and the predictors it is measured against."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from photonfarm.shared.errors import IncompleteError
from photonfarm.shared.estimate import Estimate, clean_error, group_means, noise_floor
from photonfarm.shared.keys import Key
from photonfarm.shared.records import F32
from photonfarm.trainer.dataset import Batch
from photonfarm.trainer.feed import Feed
from photonfarm.trainer.model import Cnn

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


def batches(feed: Feed, rows: Sequence[int], size: int) -> Iterator[Batch]:
    """The rows as batches, read through the feed, in their order; without those that are not complete any more."""
    for start in range(0, len(rows), size):
        feed.ask(rows[start : start + size])
        if (batch := feed.take()).rows:
            yield batch


def network_predictor(network: Cnn) -> Predictor:
    """The network's images."""
    device = next(network.parameters()).device

    @torch.no_grad()
    def predict(batch: Batch) -> F32:
        images: F32 = network(batch.to(device).inputs).cpu().numpy()
        return images

    return predict


def mean_colour(found: Iterator[Batch]) -> F32:
    """The mean exposed colour over samples and pixels, (3,): what one predicts who knows nothing of the view."""
    means = [batch.target.double().mean(dim=(1, 2, 3)).numpy() for batch in found]
    colour: F32 = np.concatenate(means).mean(axis=0).astype(np.float32)
    return colour


def constant_predictor(colour: F32) -> Predictor:
    """The same colour everywhere."""
    return lambda batch: np.broadcast_to(colour, batch.inputs.albedo.shape)


def measure(predict: Predictor, found: Iterator[Batch]) -> HeldOut:
    """The predictor's error over samples: mean (f − A)(f − B), and the noise floor mean (A − B)²/4 [estimate].

    Raises IncompleteError if there is no sample.
    """
    errors, floors = [], []
    units: list[Key] = []
    for batch in found:
        units.extend(batch.units)
        for image, (half_a, half_b) in zip(predict(batch), batch.target.numpy(), strict=True):
            errors.append(clean_error(image, half_a, half_b))
            floors.append(noise_floor(half_a, half_b))
    if not errors:
        raise IncompleteError("none of the samples to measure on is complete at present; wait for the workers")
    per_sample = np.array(errors)
    floor = float(np.mean(group_means(np.array(floors), units)))
    return HeldOut(Estimate.of(group_means(per_sample, units)), floor, per_sample)
