"""The held-out error with the noise removed, and the predictors to be measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.core.archives import Seconds
from photonfarm.core.errors import IncompleteError
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, clean_error, clean_error_having_seen_a, group_means, noise_floor
from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.store import SceneReader
from photonfarm.trainer.data.batch import TrainingBatch, allocate_memory
from photonfarm.trainer.data.feed import Feed, read_batch
from photonfarm.trainer.networks import predict_image
from photonfarm.trainer.networks.inputs import Inputs, Needs
from photonfarm.trainer.networks.network import Network

Predictor = Callable[[TrainingBatch], F32]
"""A function from a batch to its images, (B, H, W, 3), linear radiance × exposure."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutErrors:
    """Errors over held-out samples, in squared exposed radiance per channel.

    Views and passes of one configuration are similarly difficult, so they are averaged first; configurations are the
    independent units.
    """

    error: Estimate  # against the clean image, over configurations
    floor: float  # noise of the target, which would be added to an error against it
    per_sample: NDArray[np.float64]  # (n,) clean error of each
    shown: NDArray[np.float64]  # (n,) the same with light above white cut to white, as a display shows it
    units: tuple[Key, ...]  # (n,) by which each is held out: equal for those of one configuration


WHITE = np.float32(1)
"""The white of a display, in exposed radiance."""

BLOCK = 8  # px

NONE_COMPLETE = "none of the samples to measure on is complete at present; wait for the workers"

WARM_ROUNDS, TIMED_ROUNDS = 2, 15
"""The calls of each predictor, all by turns, so that other load on the machine affects all of them alike."""


@dataclass(frozen=True, slots=True, eq=False)
class DevicePredictor:
    """A `Predictor` that makes images on a device from a batch's inputs alone."""

    images: Callable[[Inputs], Tensor]  # (B, H, W, 3), linear radiance × exposure
    device: torch.device
    network: Network | None = None  # that makes them, if one does

    @torch.no_grad()
    def __call__(self, batch: TrainingBatch) -> F32:
        """A batch's images."""
        images: F32 = self.images(batch.inputs.to(self.device)).cpu().numpy()
        return images

    def of_its_own(self, inputs: Inputs) -> Inputs:
        """A copy of these inputs on the predictor's device, which outlives their batch."""
        return inputs.to(self.device, copy=True)

    @torch.no_grad()
    def work_s(self, inputs: Inputs) -> float:
        """The seconds to make the images of these inputs, which are on the device; the results are left there.

        One thread's are those of the processor, so that other load does not count; others go by the clock.
        """
        alone = self.device.type == "cpu" and torch.get_num_threads() == 1
        now = time.process_time if alone else time.perf_counter
        self._wait()
        began = now()
        self.images(inputs)
        self._wait()
        return now() - began

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def time_by_turns(calls: Sequence[tuple[DevicePredictor, Inputs]]) -> list[Seconds]:
    """The time of each predictor for its inputs, over `TIMED_ROUNDS` rounds of all; the inputs are `of_its_own`."""
    rounds = [[predict.work_s(inputs) for predict, inputs in calls] for _ in range(WARM_ROUNDS + TIMED_ROUNDS)]
    return [Seconds.of(times) for times in np.array(rounds[WARM_ROUNDS:]).T]


def read_batches(feed: Feed, rows: Sequence[int], size: int) -> Iterator[TrainingBatch]:
    """The rows as batches, read through the feed, in their order."""
    for start in range(0, len(rows), size):
        feed.ask(rows[start : start + size])
        yield feed.take()


def read_in_turn(
    source: SceneReader, rows: Sequence[int], size: int, needs: Needs, points: int | None = None
) -> Iterator[TrainingBatch]:
    """Complete rows of a source as batches in their order, each valid until the next; of the points the first ones."""
    dataset = SceneDataset(source, needs.fields, exposure=source.spec.exposure, points=points)
    memory = allocate_memory(dataset.tensors, min(size, len(rows)))
    for start in range(0, len(rows), size):
        yield read_batch(source, dataset, rows[start : start + size], needs, memory)


def make_network_predictor(network: Network) -> DevicePredictor:
    """The network as a predictor, on the device of its parameters."""
    return DevicePredictor(partial(predict_image, network), next(network.parameters()).device, network)


def average_colours(samples: Iterable[F32]) -> tuple[F32, F32]:
    """The mean colours over samples (2, H, W, 3) and their pixels, (3,) each: the best predictions without any input.

    The first is for `error`, the second for `shown`, with light above white cut to white.
    """
    means, shown = [], []
    for halves in samples:
        image = halves.mean(axis=0, dtype=np.float64)
        means.append(image.mean(axis=(0, 1)))
        shown.append(np.minimum(average_blocks(image), WHITE).mean(axis=(0, 1)))
    return np.mean(means, axis=0).astype(np.float32), np.mean(shown, axis=0).astype(np.float32)


def make_constant_predictor(colour: F32) -> Predictor:
    """A predictor of the same colour everywhere."""
    return lambda batch: np.broadcast_to(colour, batch.inputs.albedo.shape)


def choose_error(batch: TrainingBatch) -> Callable[[F32, F32, F32], float]:
    """The noise-free error of predictions for this batch, given A and B; the formula depends on whether A is input."""
    return clean_error if batch.inputs.noisy is None else clean_error_having_seen_a


def _cut_blocks(image: F32) -> F32:
    """Means over blocks of `BLOCK` × `BLOCK` pixels, with light above white cut to white.

    Without the cut a lamp in view, hundreds of times brighter than the surfaces it lights, makes up most of the error.
    Means come before the cut, as noise above white would be cut as well: of single noisy pixels the cut makes the
    targets so much darker that a network that is too dark looks better than the right one.
    """
    return np.minimum(average_blocks(image), WHITE)


def average_blocks(image: F32) -> F32:
    """Means over blocks of pixels, (H, W, 3) → (⌈H/BLOCK⌉, ⌈W/BLOCK⌉, 3); blocks at the far edges may be smaller."""
    sums, counts = image, np.ones((*image.shape[:2], 1), np.float32)
    for axis in (0, 1):
        starts = np.arange(0, image.shape[axis], BLOCK)
        sums, counts = (np.add.reduceat(values, starts, axis=axis) for values in (sums, counts))
    return (sums / counts).astype(np.float32)


def measure(predict: Predictor, samples: Iterable[TrainingBatch]) -> HeldOutErrors:
    """The error of one predictor, as `measure_together` has it."""
    return measure_together([predict], samples)[0]


def measure_together(predictors: Sequence[Predictor], samples: Iterable[TrainingBatch]) -> list[HeldOutErrors]:
    """Each predictor's error over samples: mean (f − A)(f − B), and the noise floor mean (A − B)²/4 [estimate].

    For predictors whose inputs include noisy colour, which is A's, it is mean f² − 2fB + AB. Each batch is taken once.

    Raises IncompleteError if there is no sample.
    """
    errors: list[list[list[float]]] = [[] for _ in predictors]  # by predictor, of each sample: of all light, and shown
    floors: list[float] = []
    units: list[Key] = []
    for batch in samples:
        units.extend(batch.units)
        error, halves = choose_error(batch), batch.target.cpu().numpy()
        cut = [[_cut_blocks(half) for half in of_sample] for of_sample in halves]
        floors.extend(noise_floor(*of_sample) for of_sample in halves)
        for predict, found in zip(predictors, errors, strict=True):
            for image, both, shown in zip(predict(batch), halves, cut, strict=True):
                found.append([error(image, *both), error(_cut_blocks(image), *shown)])
    if not units:
        raise IncompleteError(NONE_COMPLETE)
    floor = float(np.mean(group_means(np.array(floors), units)))

    def summarise(found: list[list[float]]) -> HeldOutErrors:
        per_sample, shown = np.array(found).T
        return HeldOutErrors(Estimate.of(group_means(per_sample, units)), floor, per_sample, shown, tuple(units))

    return [summarise(found) for found in errors]
