"""The memory that tensors hold at most while something is computed, counted as they come and go."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class LiveMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the bytes of all tensors that operations make, from when they are made until they are freed.

    What is there before does not count, nor what an operation takes and frees within itself. On a card torch's own
    count is better, but a network whose batch does not fit has none.
    """

    def __init__(self, but_for: Collection[torch.Size] = ()) -> None:
        """Leave out tensors of the shapes `but_for`."""
        super().__init__()  # type: ignore[no-untyped-call]
        self._but_for = frozenset(but_for)
        self._live: dict[int, int] = {}  # bytes of each piece of memory, by its place
        self._bytes = 0
        self.peak_bytes = 0

    def __torch_dispatch__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Compute an operation, and count what it made."""
        given = {_place(tensor) for tensor in tree_leaves((args, kwargs)) if isinstance(tensor, Tensor)}
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, Tensor) and tensor.shape not in self._but_for and _place(tensor) not in given:
                self._add(tensor)
        self.peak_bytes = max(self.peak_bytes, self._bytes)
        return made

    def _add(self, tensor: Tensor) -> None:
        storage, place = tensor.untyped_storage(), _place(tensor)
        if place in self._live:
            return
        self._live[place] = storage.nbytes()
        self._bytes += storage.nbytes()
        weakref.finalize(storage, self._free, place)

    def _free(self, place: int) -> None:
        self._bytes -= self._live.pop(place, 0)


def _place(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()
