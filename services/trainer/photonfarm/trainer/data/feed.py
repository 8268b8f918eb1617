"""A thread that follows the store and reads batches ahead, into memory that is reused."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

from photonfarm.shared.core.errors import StoreError
from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import BasePointCloud, Geometry
from photonfarm.shared.core.waiting import pause_after_look
from photonfarm.shared.plan.hold_out import are_held_out, enough, units_of
from photonfarm.trainer.data.dataset import SampleSource, TrainingBatch, read_into
from photonfarm.trainer.data.resident import ResidentSamples
from photonfarm.trainer.networks import kind_of
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.runs.device import usable_device
from photonfarm.trainer.runs.settings import TrainSettings


class Feed:
    """Batches in the order of their requests, and rows as they arrive; a context manager.

    Rows that are incomplete when they are read, for instance after a repair of the store, are left out of their batch,
    until they are complete again. Only the feed's thread uses the source. On a CPU there is no cache of samples besides
    the batches, unless one is asked for: to read a sample from the system's cache, checked, takes less than half of the
    time to write it into a batch (docs/results/train_step.md), so that a cache would hardly be worth its memory.
    """

    def __init__(
        self,
        source: SampleSource,
        settings: TrainSettings,
        clock: Callable[[], float] = time.monotonic,
        needs: Needs | None = None,
        resident: ResidentSamples | None = None,
    ) -> None:
        """Feed a batch with the inputs that the settings' network needs, or those in `needs`.

        With `resident`, samples are kept there, and batches are on its device.
        """
        self.geometry: Geometry
        self.cloud: BasePointCloud
        self._source, self._settings, self._clock = source, settings, clock
        self._needs = needs or kind_of(settings.network.architecture).needs
        self._resident = resident if resident is not None and resident.keeps_any else None
        if self._needs.guides:
            source.read_guides()
        self.geometry, self.cloud = source.base()
        self.spec = source.spec
        self._lock = threading.Lock()
        self._arrived: list[tuple[int, bool]] = []
        self._complete = False
        self._plans: list[dict[str, Any]] = []
        self._sides: set[bool] = set()  # whether samples so far are held out
        self._units: set[Key] = set()  # what is held out as one, until some are and some are not
        self._here: set[int] = set()  # rows that are complete
        self._known: set[int] = set()  # rows that are or were complete
        self._error: BaseException | None = None
        points = min(settings.network.points or len(self.cloud.position), len(self.cloud.position))
        pinned = usable_device(settings.device).type == "cuda"
        self._asked: queue.SimpleQueue[tuple[int, ...] | None] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[tuple[TrainingBatch, TrainingBatch] | None] = queue.SimpleQueue()
        self._free: queue.SimpleQueue[TrainingBatch | None] = queue.SimpleQueue()
        for _ in range(settings.prefetch + 1):
            self._free.put(TrainingBatch.empty(settings.batch, points, self.spec, self._needs, pinned=pinned))
        self._lent: TrainingBatch | None = None
        self._polled = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._polled.wait()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._free.put(None)
        self._asked.put(None)
        self._thread.join()

    def ask(self, rows: Sequence[int]) -> None:
        """Request a batch of these rows, at most `batch` of them."""
        self._asked.put(tuple(rows))

    def take(self) -> TrainingBatch:
        """The next requested batch. The one taken before is then no longer valid. Raises the errors of reading."""
        if self._lent is not None:
            self._free.put(self._lent)
        got = self._ready.get()
        if got is None:
            self._raise()
            raise RuntimeError("the feed is closed")
        batch, self._lent = got
        return batch

    def arrivals(self) -> tuple[list[tuple[int, bool]], bool]:
        """The rows that became complete since the last call, each with whether it is held out; and whether all have.

        The second is True once everything planned has been complete. A row that a repair removed is reported again when
        it is complete again. Raises the errors of reading.
        """
        self._raise()
        with self._lock:
            rows, self._arrived = self._arrived, []
            return rows, self._complete

    def plan_requests(self) -> list[dict[str, Any]]:
        """The requests of all plans, as of the last look at the store."""
        with self._lock:
            return self._plans

    def other_hold_out(self) -> float | None:
        """A share that splits what has arrived, where the settings' one leaves one side empty; None if none does."""
        with self._lock:
            return enough(self._units, least=0.0)

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:  # passed on to the thread that takes
            self._error = error
        finally:
            self._polled.set()
            self._ready.put(None)

    def _serve(self) -> None:
        due = self._clock()
        while True:
            if self._clock() >= due:
                began = self._clock()
                self._poll()
                due = self._clock() + pause_after_look(self._clock() - began, self._settings.poll_seconds)
            try:
                rows = self._asked.get(timeout=max(due - self._clock(), 0.0))
            except queue.Empty:
                continue
            memory = self._free.get() if rows is not None else None
            if rows is None or memory is None:
                return
            self._ready.put((self._read(rows, memory), memory))

    def _poll(self) -> None:
        rows = [int(row) for row in self._source.refresh()]
        gone = [int(row) for row in self._source.taken_back]
        self._here.difference_update(gone)
        if self._resident is not None:
            self._resident.forget(gone)
        self._here.update(rows)
        self._known.update(rows)
        units = units_of(self._source, rows)
        held_out = are_held_out(units, self._settings.hold_out)
        with self._lock:
            self._arrived.extend(zip(rows, held_out, strict=True))
            self._sides.update(held_out)
            self._units = set() if len(self._sides) > 1 else self._units.union(units)
            self._plans = list(self._source.plan_requests)
            self._complete = 0 < self._source.planned <= len(self._known)
        self._polled.set()

    def _read(self, rows: Sequence[int], memory: TrainingBatch) -> TrainingBatch:
        """Read those of the rows that are complete."""
        if not self._known.issuperset(rows):
            self._poll()  # another reader has seen them arrive
        try:
            return self._read_complete(rows, memory)
        except StoreError:
            self._poll()  # since then a repair may have set some aside, and a worker may have rendered them again
            return self._read_complete(rows, memory)

    def _read_complete(self, rows: Sequence[int], memory: TrainingBatch) -> TrainingBatch:
        there = [row for row in rows if row in self._here]
        if self._resident is None:
            return read_into(memory, self._source, there, self._needs, self.cloud)
        fresh = read_into(memory, self._source, self._resident.lacking(there), self._needs, self.cloud)
        return self._resident.batch(there, fresh)
