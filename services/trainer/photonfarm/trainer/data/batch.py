"""Batches as tensors, and those of their samples that stay in the memory of a device.

Shape letters: B batch, H W image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Key, Stream
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour, map_tensors, require
from photonfarm.trainer.runs.devices import is_asynchronous

FREE_SHARE = 0.25
"""The share of a card's memory that stays free with "auto".

It is measured before each sample is kept. Most samples come after the first steps, when torch holds the memory that
steps need.
"""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingBatch:
    """Samples as tensors; valid until the next batch is taken."""

    rows: tuple[int, ...]
    units: tuple[Key, ...]  # by which each is held out: equal for samples that are not independent
    inputs: Inputs
    target: Tensor  # (B, 2, H, W, 3) half-estimates A and B, or (B, 1, …) with noisy colour; linear radiance × exposure
    other: NoisyColour | None = None  # with noisy colour, which is A's: the same of B

    @classmethod
    def of(
        cls,
        rows: Sequence[int],
        units: Sequence[Key],
        tensors: Mapping[str, Tensor],
        kept: Tensor | None = None,
        passes: tuple[Tensor, Tensor] | None = None,
        given: NoisyColour | None = None,
    ) -> TrainingBatch:
        """What a `SceneDataset` has read, (B, …) by field, in the same memory; and A's `kept` pixels, (B, H, W).

        `passes` are how many each sample is the mean of, (B,), and the variances of both halves, (B, 2, H, W). What is
        `given` stands for A's as an input alone: it has to be independent of B.
        """
        target = tensors["radiance"]
        if kept is None:
            return cls(tuple(rows), tuple(units), Inputs.of(tensors), target)
        count, variance = (None, (None, None)) if passes is None else (passes[0], passes[1].unbind(1))
        halves = zip(target.unbind(1), variance, strict=True)
        a, b = (NoisyColour(half * kept[..., None], kept, count, of) for half, of in halves)
        return cls(tuple(rows), tuple(units), Inputs.of(tensors, given or a), target, b)

    def to(self, device: torch.device) -> TrainingBatch:
        """The same batch on a device; itself on the CPU. A card may still be copying, as by `Inputs.to`."""

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device, non_blocking=is_asynchronous(device))

        other = None if self.other is None else map_tensors(move, self.other)
        return TrainingBatch(self.rows, self.units, self.inputs.to(device), move(self.target), other)

    def for_training(self) -> TrainingBatch:
        """The batch with targets that no input depends on: itself, unless its inputs hold noisy colour.

        Otherwise it is twice as long: the samples with A in the inputs and B as the target, (B, 1, H, W, 3), then the
        same samples with both exchanged (Lehtinen et al., Noise2Noise, 2018). The same pixels are kept of both.
        """
        if self.other is None:
            return self
        inputs = map_tensors(lambda *both: torch.cat(both), self.inputs, replace(self.inputs, noisy=self.other))
        target = torch.cat([self.target[:, 1:], self.target[:, :1]])
        return TrainingBatch(2 * self.rows, 2 * self.units, inputs, target)


def allocate_memory(tensors: SampleTensors, size: int, *, pinned: bool = False) -> dict[str, Tensor]:
    """Memory for `size` samples, by field, which is reused for every batch; SpecError where there is not so much."""
    try:
        return tensors.empty(size, pinned=pinned)
    except RuntimeError as error:  # torch's error for want of memory
        raise SpecError(f"batch = {size}: no memory for so many samples") from error


def count_kept(spec: SceneSpec, of: int) -> int:
    """The number of pixels that one of `of` makes; SpecError if the film has fewer than `of` pixels."""
    pixels = spec.film.height * spec.film.width
    if of > pixels:
        raise SpecError(
            f"one of {of} pixels is to be kept, and the film has {pixels} ({spec.film.width}×{spec.film.height}); "
            "keep one of fewer"
        )
    return pixels // of


def choose_kept_pixels(key: Key, spec: SceneSpec, of: int) -> NDArray[np.bool_]:
    """One of `of` pixels, (H, W), H·W / `of` in all: a random choice derived from a sample's content key.

    So each pass of a view keeps pixels of its own, and a resumed run gets the same pixels. A smaller share of the
    pixels is a subset of a larger one. Raises SpecError as `count_kept` does.
    """
    film = spec.film.height, spec.film.width
    chance = Stream(key, "kept pixels").uniform(*film)
    last = count_kept(spec, of) - 1
    kept: NDArray[np.bool_] = chance <= np.partition(chance, last, axis=None)[last]
    return kept


class ResidentSamples:
    """The decoded samples on a device, up to a limit. What is kept stays: in rounds, the oldest is the next one drawn.

    One thread uses it. On CUDA its copies and the steps are in one stream, in the order in which they were asked for.
    """

    def __init__(self, device: torch.device, limit_gb: float | Literal["auto"]) -> None:
        """Keep up to `limit_gb` 10⁹ bytes; by "auto" none on a CPU, and on CUDA while `FREE_SHARE` of it is free."""
        self._device = device
        self._limit_bytes = None if limit_gb == "auto" else limit_gb * 1e9  # None: "auto"
        self._kept: dict[int, TrainingBatch] = {}  # batches of one sample, by row
        self._bytes = 0

    @property
    def makes_batches(self) -> bool:
        """Whether batches come from here: on a card, so that no step copies one, or where any samples may be kept."""
        return is_asynchronous(self._device) or bool(self._limit_bytes)

    @property
    def rows(self) -> tuple[int, ...]:
        """The rows of the samples that are kept."""
        return tuple(self._kept)

    def list_lacking(self, rows: Iterable[int]) -> list[int]:
        """Those of the rows that are not kept, each once, in their order."""
        return [row for row in dict.fromkeys(rows) if row not in self._kept]

    def batch(self, rows: Sequence[int], fresh: TrainingBatch) -> TrainingBatch:
        """The batch of these rows on the device, of which `fresh` has those that `list_lacking` gave; keeps what fits.

        Its tensors are its own. Values are those of the store's samples, to the bit, wherever they were kept.
        """
        moved = fresh.to(self._device)
        if fresh.rows and is_asynchronous(self._device):  # whose memory may hold other samples from now on
            torch.cuda.current_stream(self._device).synchronize()
        parts = {row: take_one(moved, place) for place, row in enumerate(fresh.rows)}
        for row, part in parts.items():
            if self._has_room(needed := count_bytes(part)):
                self._kept[row] = _map_batch(torch.clone, part)
                self._bytes += needed
        return _join_samples([parts[row] if row in parts else self._kept[row] for row in rows]) if rows else moved

    def _has_room(self, needed: int) -> bool:
        if self._limit_bytes is not None:
            return self._bytes + needed <= self._limit_bytes
        free, total = torch.cuda.mem_get_info(self._device)
        return free - needed >= FREE_SHARE * total


def count_bytes(record: Any) -> int:
    """The bytes of all tensors of a batch, or of its inputs."""
    if isinstance(record, Tensor):
        return record.numel() * record.element_size()
    return sum(count_bytes(getattr(record, f.name)) for f in fields(record)) if is_dataclass(record) else 0


def take_one(batch: TrainingBatch, place: int) -> TrainingBatch:
    """One sample of a batch, in the batch's memory."""
    one = _map_batch(lambda tensor: tensor[place : place + 1], batch)
    return replace(one, rows=(batch.rows[place],), units=(batch.units[place],))


def _join_samples(samples: Sequence[TrainingBatch]) -> TrainingBatch:
    """Samples as a batch in memory of its own."""
    rows, units = (tuple(getattr(sample, name)[0] for sample in samples) for name in ("rows", "units"))
    return replace(_map_batch(lambda *parts: torch.cat(parts), *samples), rows=rows, units=units)


def _map_batch(change: Callable[..., Tensor], batch: TrainingBatch, *others: TrainingBatch) -> TrainingBatch:
    """The batch with `change` applied to each tensor, and to the matching ones of other batches."""
    inputs = map_tensors(change, batch.inputs, *(each.inputs for each in others))
    target = change(batch.target, *(each.target for each in others))
    other = None if batch.other is None else map_tensors(change, batch.other, *(require(each.other) for each in others))
    return TrainingBatch(batch.rows, batch.units, inputs, target, other)
