"""The device of a network, and several processes that train one network, as `torchrun` starts them.

Each process has its part of every batch. Rank 0 follows the store, draws, validates, writes and logs; the other ranks
read and compute at its commands. In each step all ranks take the mean gradient over the joint batch, in one piece. The
parts of a batch may differ in length, and DistributedDataParallel would weigh them alike. It also sends gradients while
others are computed, but that gains little, as these networks spend their time in convolutions.

All processes must see the same store and the same run folder, in which ranks find the checkpoint of a resumed run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor, distributed, nn

from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.trainer.runs.settings import Precision

AUTO = "auto"


def usable_device(name: str) -> torch.device:
    """The device of this name, "cpu", "cuda" or "cuda:N"; for "auto", cuda if there is one and otherwise the cpu.

    On CUDA float32 then means float32 in this process: by torch's default convolutions round their factors to TF32,
    whose mantissa has 10 bits. That is done where a network is asked for it, by `round_convolutions`. The quickest
    convolution is found by trying all when a shape is first seen. Raises SpecError if torch cannot use the device.
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise SpecError(f"device = {name!r}: must be auto, cpu, cuda or cuda:N")
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == AUTO else name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter if torch was built without CUDA
        raise SpecError(f"device = {name!r}: cannot be used here: {str(error).splitlines()[0]}") from error
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cudnn.benchmark = not torch.are_deterministic_algorithms_enabled()
    return device


def compute_deterministically(device: torch.device) -> None:
    """Let torch make equal values of equal ones on CUDA, from now on in this process; a processor does so anyway.

    Sums are taken in a fixed order then, and no convolution is chosen by its time, which differs from one process to
    the next. cuBLAS heeds its variable if it has not computed before. An operation that torch has in no such form, as a
    user's network may hold, raises torch's own RuntimeError, which names it.
    """
    if device.type == "cuda":
        os.environ["CUBLAS_WORKSPACE_CONFIG"] = ":4096:8"
        torch.backends.cudnn.benchmark = False
        torch.use_deterministic_algorithms(mode=True)


def is_asynchronous(device: torch.device) -> bool:
    """Whether a device works on while Python hands it more, so that to read a number from it is to wait: a card."""
    return device.type != "cpu"


def choose_preset(device: str = AUTO) -> str:
    """The preset of settings for a device of this name: "card" where that is a card, "small" on a processor."""
    return "card" if _is_card(device) else "small"


def round_convolutions(device: torch.device, precision: Precision) -> None:
    """Let convolutions on CUDA round their factors to TF32 from now on, or not; their sums are float32 either way.

    With bfloat16 that is the last convolution, whose inputs have fewer digits than TF32 already. The setting is the
    process's, and a gradient's convolutions heed it too. So a network sets it before each image.
    """
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = precision != "float32"


def describe_device(device: torch.device, precision: Precision = "float32") -> str:
    """The device in words: "cpu", or "cuda (NVIDIA H200)"; with a warning if it is slow at this precision."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    if precision == "tf32":
        return f"{device}, which has no TF32, and computes in float32 instead"
    if precision == "bfloat16" and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return f"{device}, which has no instructions for bfloat16: precision = float32 is several times faster here"
    return str(device)


COMMAND_PATIENCE = timedelta(days=30)
"""The longest time that a rank waits for its next command: as long as a store may take to grow."""

STEP_PATIENCE = timedelta(minutes=15)
"""The longest time that a rank waits for the others within a step.

Reading a part of a batch may take minutes if the store is in a bucket; a rank that takes longer hangs.
"""


class Ranks:
    """The processes that share each batch, as one of them uses them, or one that trains alone.

    Raises IncompleteError if another one has ended or hangs.
    """

    def __init__(self, commands: distributed.ProcessGroup | None = None) -> None:
        """Take `commands`, a group of the processes of torch's default group, by which rank 0 sends commands."""
        self.rank, self.size = (distributed.get_rank(), distributed.get_world_size()) if commands else (0, 1)
        self._commands = commands
        self.within_step = False  # the others wait for this one's gradient, and take no command before they have it

    def device(self, name: str) -> torch.device:
        """The device of this process, given the `name` in the settings; "cuda" is the card with its local rank."""
        return usable_device(name if self.size == 1 else _choose_own_device(name))

    def part(self, rows: Sequence[int]) -> tuple[int, ...]:
        """The rows of a batch that this process reads: every `size`-th one, beginning with this rank's."""
        return tuple(rows[self.rank :: self.size])

    def send(self, command: str, value: Any = None) -> None:
        """Send the other ranks a command; for rank 0."""
        self._broadcast([command, value])
        self.within_step = command == "take" and self.size > 1

    def receive(self) -> tuple[str, Any]:
        """Receive the next command of rank 0; for the others."""
        command, value = self._broadcast([None, None])
        return command, value

    def _broadcast(self, objects: list[Any]) -> list[Any]:
        if self._commands:
            with self._others_there():
                distributed.broadcast_object_list(objects, src=0, group=self._commands)
        return objects

    def meet(self) -> None:
        """Wait until all processes call this."""
        if self.size > 1:
            with self._others_there():
                distributed.all_reduce(torch.zeros(()))

    def average_gradients(self, weights: Sequence[nn.Parameter], loss: Tensor, count: int) -> Tensor:
        """The loss over the joint batch, (), whose gradient the weights get; `count` of its samples are here."""
        if self.size == 1:
            return loss.detach()
        gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in weights]
        own = torch.cat([*(g.flatten() for g in gradients), loss.detach().reshape(1)])
        *means, mean_loss = torch.split(self.average(own, count), [*(g.numel() for g in gradients), 1])
        self.within_step = False
        for weight, mean in zip(weights, means, strict=True):
            weight.grad = mean.view_as(weight)
        return mean_loss[0]

    def average(self, means: Tensor, count: int) -> Tensor:
        """Means over the joint batch, (k,), given those over the `count` samples here."""
        if self.size == 1:
            return means
        sums = torch.cat([means * count, means.new_full((1,), count)])
        with self._others_there():
            distributed.all_reduce(sums)
        return sums[:-1] / sums[-1]

    @contextmanager
    def lead(self) -> Iterator[None]:
        """Run rank 0's training in the block, and then send the other ranks the command to end.

        Within a step they take no command; they notice then that rank 0 is gone.
        """
        try:
            yield
        finally:
            if not self.within_step:
                with suppress(IncompleteError):  # they have ended already
                    self.send("end")

    @contextmanager
    def _others_there(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # torch's own errors differ by backend
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise IncompleteError(f"rank {self.rank}: another process of this training is gone: {reason}") from error


def count_processes() -> int:
    """The number of processes that torchrun has started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def join_ranks(device: str, batch: int) -> Iterator[Ranks]:
    """Join the processes that torchrun has started, if it has.

    Raises SpecError for a batch of fewer samples than there are processes.
    """
    size = count_processes()
    if size < 2:
        yield Ranks()
        return
    if batch < size:
        raise SpecError(
            f"batch = {batch}: has fewer samples than the {size} processes that share it; set batch to {size} or more"
        )
    own = usable_device(_choose_own_device(device))
    if own.type == "cuda":
        torch.cuda.set_device(own)
    distributed.init_process_group("cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo", timeout=STEP_PATIENCE)
    try:
        yield Ranks(distributed.new_group(backend="gloo", timeout=COMMAND_PATIENCE))
    finally:
        distributed.destroy_process_group()


def _choose_own_device(device: str) -> str:
    """The process's own card if the settings name CUDA or `auto` finds it; raises SpecError for one named card."""
    if device.startswith("cuda:"):
        raise SpecError(
            f"device = {device!r}: names one card, but {count_processes()} processes need one each; give cuda"
        )
    return f"cuda:{os.environ['LOCAL_RANK']}" if _is_card(device) else device


def _is_card(device: str) -> bool:
    """Whether a device's name stands for a card here; none is touched, as that would take memory of it."""
    return device.startswith("cuda") or (device == AUTO and torch.cuda.is_available())
