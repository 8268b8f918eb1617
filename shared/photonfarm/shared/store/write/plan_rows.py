"""A stored plan's inputs, read when they are needed: some rows by their chunks, or everything at once.

A worker needs the rows of one job at a time. Of ten million samples all inputs would be gigabytes in each worker.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.records import F32
from photonfarm.shared.plan.request import InputName, PlannedRows
from photonfarm.shared.store.format.plain_inputs import UNLIKE, PlainInput
from photonfarm.shared.store.io.storage import Storage

INPUT_NAMES: tuple[InputName, ...] = get_args(InputName)

CHUNKS_KEPT = 2
"""The chunks of each input that are kept: the jobs that workers take one after the other lie side by side."""


class StoredRows:
    """The inputs of one plan, as `PlannedRows` has them; those that are read stay in memory."""

    def __init__(self, storage: Storage, folder: str, read_all: Callable[[], PlannedRows]) -> None:
        """Take the plan's folder, and what reads all of it and raises CorruptError; nothing is read yet."""
        self._storage, self._folder, self._read_all = storage, folder, read_all
        self._all: PlannedRows | None = None
        self._inputs: dict[InputName, PlainInput] = {}
        self._chunks: dict[InputName, OrderedDict[int, NDArray[Any]]] = {}
        self._wholes: dict[InputName, NDArray[Any]] = {}
        self._sound: dict[InputName, set[int]] = {}  # the chunks that were read, and were as they were written

    def load(self) -> PlannedRows:
        """All inputs; raises CorruptError if one is not as it was written."""
        if self._all is None:
            self._all = self._read_all()
            self._chunks.clear()
            self._wholes.clear()
        return self._all

    def some(self, name: InputName, rows: NDArray[np.int64]) -> NDArray[Any]:
        """The values of an input in some rows, counted within the plan; raises CorruptError and IndexError.

        Only the chunks of these rows are read, unless everything has been read, or is not as it is written here.
        """
        if self._all is None:
            try:
                return self._by_chunks(name, rows)
            except UNLIKE:
                self.load()
        return self.load().some(name, rows)

    def check(self, rows: NDArray[np.int64]) -> None:
        """Read the chunks of some rows of every input that were not read before; raises CorruptError.

        They are not kept.
        """
        if self._all is not None:
            return
        try:
            for name in INPUT_NAMES:
                numbers = np.unique(rows // self._input(name).chunk_rows)
                for number in set(numbers.tolist()) - self._sound.setdefault(name, set()):
                    self._read(name, number)
        except UNLIKE:
            self.load()

    def _by_chunks(self, name: InputName, rows: NDArray[np.int64]) -> NDArray[Any]:
        number, within = np.divmod(np.asarray(rows, np.int64), self._input(name).chunk_rows)
        parts = {each: self._chunk(name, each)[within[number == each]] for each in np.unique(number).tolist()}
        if len(parts) == 1:
            return next(iter(parts.values()))
        first = self._chunk(name, 0) if not parts else next(iter(parts.values()))
        values = np.empty((len(number), *first.shape[1:]), first.dtype)
        for each, part in parts.items():
            values[number == each] = part
        return values

    def _chunk(self, name: InputName, number: int) -> NDArray[Any]:
        kept = self._chunks.setdefault(name, OrderedDict())
        if number not in kept:
            kept[number] = self._read(name, number)
            while len(kept) > CHUNKS_KEPT:
                kept.popitem(last=False)
        kept.move_to_end(number)
        return kept[number]

    def _input(self, name: InputName) -> PlainInput:
        if name not in self._inputs:
            self._inputs[name] = PlainInput(self._storage, f"{self._folder}/{name}")
        return self._inputs[name]

    def _read(self, name: InputName, number: int) -> NDArray[Any]:
        values = self._input(name).rows_of(number)
        self._sound.setdefault(name, set()).add(number)
        return values

    def _whole(self, name: InputName) -> NDArray[Any]:
        """An input of all rows; the others are not read for it."""
        if self._all is not None:
            return self._all.of(name)
        if name not in self._wholes:
            try:
                self._wholes[name] = self._input(name).all()
            except UNLIKE:
                return self.load().of(name)
        return self._wholes[name]

    @property
    def modification(self) -> F32:
        """The modifications of all rows; see `PlannedRows`."""
        return self._whole("modification")

    @property
    def view(self) -> F32:
        """See `PlannedRows`."""
        return self._whole("view")

    @property
    def sample_modification(self) -> NDArray[np.int64]:
        """See `PlannedRows`."""
        return self._whole("sample_modification")

    @property
    def sample_view(self) -> NDArray[np.int64]:
        """See `PlannedRows`."""
        return self._whole("sample_view")

    @property
    def sample_pass(self) -> NDArray[np.int32]:
        """See `PlannedRows`."""
        return self._whole("sample_pass")

    @property
    def sample_key(self) -> NDArray[np.uint8]:
        """See `PlannedRows`."""
        return self._whole("sample_key")
