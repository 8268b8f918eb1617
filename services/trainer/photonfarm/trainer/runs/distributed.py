"""Several processes that train one network, each on its part of every batch, as `torchrun` starts them.

Rank 0 follows the store, draws, validates, writes and talks; the others read and compute what it tells them to. Of each
step all take the mean gradient over the joint batch, in one piece: as samples can be taken back while they are read,
parts may differ in length, which DistributedDataParallel does not allow. That it would send while gradients are still
being computed is worth little beside the convolutions of these networks.

All must see the same run folder, where the others find the checkpoint that a run goes on from, and the same store.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any, Protocol

import torch
from torch import Tensor, distributed, nn

from photonfarm.shared.core.errors import IncompleteError, SpecError
from photonfarm.trainer.runs.device import AUTO, usable_device

WORD_PATIENCE = timedelta(days=30)
"""How long a rank waits for the next thing to do: as long as a store may take to grow."""

STEP_PATIENCE = timedelta(minutes=15)
"""How long a rank waits for the others within a step: reading a part of a batch may take minutes where the store is in
a bucket, and whoever takes longer hangs."""


class Group(Protocol):
    """The processes that share each batch, seen from one of them."""

    within_step: bool  # the others wait for this one's gradient, and hear no word before they have it

    def device(self, name: str) -> torch.device:
        """The device of this process, where `name` is that of the settings."""

    def part(self, rows: Sequence[int]) -> tuple[int, ...]:
        """Which rows of a batch this process reads."""

    def tell(self, what: str, told: Any = None) -> None:
        """Tell the other ranks what to do; for rank 0."""

    def joined(self, rows: Sequence[int]) -> tuple[int, ...]:
        """The rows that all processes have read of a batch; all must call."""

    def average(self, weights: Sequence[nn.Parameter], loss: Tensor, count: int) -> float:
        """The loss over the joint batch, whose gradient the weights then have; `count` samples are of this process."""


class Alone:
    """A process that trains by itself."""

    within_step = False

    def device(self, name: str) -> torch.device:
        """The device that the settings name."""
        return usable_device(name)

    def part(self, rows: Sequence[int]) -> tuple[int, ...]:
        """All of them."""
        return tuple(rows)

    def tell(self, what: str, told: Any = None) -> None:
        """There is nobody to tell."""

    def joined(self, rows: Sequence[int]) -> tuple[int, ...]:
        """The same rows."""
        return tuple(rows)

    def average(self, weights: Sequence[nn.Parameter], loss: Tensor, count: int) -> float:  # noqa: ARG002
        """The loss; the weights have its gradient."""
        return loss.item()


ALONE = Alone()


class Ranks:
    """One of the processes of torch's default group. Raises IncompleteError where another one has ended or hangs."""

    def __init__(self, words: distributed.ProcessGroup) -> None:
        """`words` is a group of the same processes, by which rank 0 tells the others what to do."""
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()
        self._words = words
        self.within_step = False

    def device(self, name: str) -> torch.device:
        """Of "cuda" the one of this process on its machine."""
        return usable_device(_own(name))

    def part(self, rows: Sequence[int]) -> tuple[int, ...]:
        """Every `size`-th row, from the one of this rank on."""
        return tuple(rows[self.rank :: self.size])

    def tell(self, what: str, told: Any = None) -> None:
        """Tell the other ranks what to do; for rank 0."""
        with self._others_there():
            distributed.broadcast_object_list([what, told], src=0, group=self._words)

    def hear(self) -> tuple[str, Any]:
        """What rank 0 tells next; for the others."""
        heard: list[Any] = [None, None]
        with self._others_there():
            distributed.broadcast_object_list(heard, src=0, group=self._words)
        return heard[0], heard[1]

    def joined(self, rows: Sequence[int]) -> tuple[int, ...]:
        """The rows that all processes have read of a batch; all must call."""
        parts: list[Any] = [None] * self.size
        with self._others_there():
            distributed.all_gather_object(parts, tuple(rows))
        there = tuple(row for part in parts for row in part)
        self.within_step = bool(there)
        return there

    def average(self, weights: Sequence[nn.Parameter], loss: Tensor, count: int) -> float:
        """The mean of losses and gradients, weighted by how many samples each process had."""
        gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in weights]
        sums = torch.cat([*(g.flatten() for g in gradients), loss.detach().reshape(1)]) * count
        sums = torch.cat([sums, sums.new_tensor([count])])
        with self._others_there():
            distributed.all_reduce(sums)
        self.within_step = False
        *means, mean_loss = torch.split(sums[:-1] / sums[-1], [*(g.numel() for g in gradients), 1])
        for weight, mean in zip(weights, means, strict=True):
            weight.grad = mean.view_as(weight)
        return mean_loss.item()

    @contextmanager
    def _others_there(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # torch's own differ by backend
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise IncompleteError(f"rank {self.rank}: another process of this training is gone: {reason}") from error


def processes() -> int:
    """How many processes torchrun has started, this one among them; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def leading(group: Group) -> Iterator[None]:
    """Rank 0 trains within; however that ends, the others are told to end, or see that it is gone."""
    try:
        yield
    finally:
        if not group.within_step:
            with suppress(IncompleteError):  # they have ended
                group.tell("end")


@contextmanager
def ranks(device: str, batch: int) -> Iterator[Ranks | None]:
    """Which of the processes that torchrun has started this is; None where there are no others.

    Raises SpecError for a batch of fewer samples than there are processes.
    """
    size = processes()
    if size < 2:
        yield None
        return
    if batch < size:
        raise SpecError(f"batch = {batch}: is shared by {size} processes, and each needs a sample of it")
    own = usable_device(_own(device))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    distributed.init_process_group("cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo", timeout=STEP_PATIENCE)
    try:
        yield Ranks(distributed.new_group(backend="gloo", timeout=WORD_PATIENCE))
    finally:
        distributed.destroy_process_group()


def _own(device: str) -> str:
    """Where the settings name CUDA, or `auto` finds it, the card of this process; SpecError for a single card."""
    if device.startswith("cuda:"):
        raise SpecError(f"device = {device!r}: is one card, and {processes()} processes want one each; name cuda")
    on_cuda = device == "cuda" or (device == AUTO and torch.cuda.is_available())
    return f"cuda:{os.environ['LOCAL_RANK']}" if on_cuda else device
