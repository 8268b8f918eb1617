"""Decoded samples that stay in the memory of a device, so that each is read and copied there once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from photonfarm.trainer.data.dataset import TrainingBatch
from photonfarm.trainer.networks.inputs import map_tensors

FREE_SHARE = 0.25
"""The share of a card's memory that stays free with "auto".

It is measured before each sample is kept. Most samples come after the first steps, when torch holds the memory that
steps need.
"""


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
    def keeps_any(self) -> bool:
        """Whether there is a limit above 0."""
        return self._device.type == "cuda" if self._limit_bytes is None else self._limit_bytes > 0

    @property
    def rows(self) -> tuple[int, ...]:
        """The rows of the samples that are kept."""
        return tuple(self._kept)

    def lacking(self, rows: Iterable[int]) -> list[int]:
        """Those of the rows that are not kept, each once, in their order."""
        return [row for row in dict.fromkeys(rows) if row not in self._kept]

    def forget(self, rows: Iterable[int]) -> None:
        """Drop samples that are set aside in the store, as they are rendered again."""
        for row in rows:
            if (sample := self._kept.pop(row, None)) is not None:
                self._bytes -= size_bytes(sample)

    def batch(self, rows: Sequence[int], fresh: TrainingBatch) -> TrainingBatch:
        """The batch of these rows on the device, of which `fresh` has those that were `lacking`; keeps what fits.

        Its tensors are its own. Values are those of the store's samples, to the bit, wherever they were kept.
        """
        moved = fresh.to(self._device)
        parts = {row: _one(moved, place) for place, row in enumerate(fresh.rows)}
        for row, part in parts.items():
            if self._has_room(needed := size_bytes(part)):
                self._kept[row], self._bytes = _changed(torch.clone, part), self._bytes + needed
        return _joined([parts[row] if row in parts else self._kept[row] for row in rows]) if rows else moved

    def _has_room(self, needed: int) -> bool:
        if self._limit_bytes is not None:
            return self._bytes + needed <= self._limit_bytes
        free, total = torch.cuda.mem_get_info(self._device)
        return free - needed >= FREE_SHARE * total


def size_bytes(record: Any) -> int:
    """The bytes of all tensors of a batch, or of its inputs."""
    if isinstance(record, Tensor):
        return record.numel() * record.element_size()
    return sum(size_bytes(getattr(record, f.name)) for f in fields(record)) if is_dataclass(record) else 0


def _one(batch: TrainingBatch, place: int) -> TrainingBatch:
    """One sample of a batch, in the batch's memory."""
    inputs = map_tensors(lambda tensor: tensor[place : place + 1], batch.inputs)
    return TrainingBatch((batch.rows[place],), (batch.units[place],), inputs, batch.target[place : place + 1])


def _changed(change: Callable[[Tensor], Tensor], sample: TrainingBatch) -> TrainingBatch:
    """The sample with `change` applied to its tensors."""
    return TrainingBatch(sample.rows, sample.units, map_tensors(change, sample.inputs), change(sample.target))


def _joined(samples: Sequence[TrainingBatch]) -> TrainingBatch:
    """Samples as a batch in memory of its own."""
    rows, units = (tuple(getattr(sample, name)[0] for sample in samples) for name in ("rows", "units"))
    first, *others = (sample.inputs for sample in samples)
    inputs = map_tensors(lambda *parts: torch.cat(parts), first, *others)
    return TrainingBatch(rows, units, inputs, torch.cat([sample.target for sample in samples]))
