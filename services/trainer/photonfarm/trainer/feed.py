"""A thread that follows the store and reads batches ahead, into memory that is used again and again."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from photonfarm.shared.errors import StoreError
from photonfarm.shared.records import BasePointCloud, Geometry
from photonfarm.trainer.dataset import Batch, Compact, SampleSource, fill, rows_held_out
from photonfarm.trainer.settings import TrainSettings


class Feed:
    """Batches in the order they were asked for, and the rows as they arrive; a context manager.

    Rows that are not complete when they are read, as a repair of the store may have taken them back, are left out of
    their batch, until they have become complete again. Only its thread touches the source. Decoded samples are kept up
    to `cache_bytes`: the first ones stay, since every sample is drawn about equally often, which is where replacing the
    least recently used one never hits.
    """

    def __init__(
        self, source: SampleSource, settings: TrainSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.geometry: Geometry
        self.cloud: BasePointCloud
        self.geometry, self.cloud = source.base()
        self.spec = source.spec
        self._source, self._settings, self._clock = source, settings, clock
        self._cache: dict[int, Compact] = {}
        self._cached_bytes = 0
        self._lock = threading.Lock()
        self._arrived: list[tuple[int, bool]] = []
        self._complete = False
        self._here: set[int] = set()  # rows that are complete
        self._gone: set[int] = set()  # rows that were
        self._error: BaseException | None = None
        points = min(settings.network.points or len(self.cloud.position), len(self.cloud.position))
        pinned = settings.device.startswith("cuda")
        self._asked: queue.SimpleQueue[tuple[int, ...] | None] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[tuple[Batch, Batch] | None] = queue.SimpleQueue()
        self._free: queue.SimpleQueue[Batch | None] = queue.SimpleQueue()
        for _ in range(settings.prefetch + 1):
            self._free.put(Batch.empty(settings.batch, points, self.spec, pinned=pinned))
        self._lent: Batch | None = None
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
        """Have a batch of these rows read; at most `batch` of them."""
        self._asked.put(tuple(rows))

    def take(self) -> Batch:
        """The next batch asked for, read. The one taken before is no longer valid. Raises what the reading raised."""
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

        The second is True once everything that is planned has been complete. A row that was taken back is told again
        when it has become complete again. Raises what the reading raised.
        """
        self._raise()
        with self._lock:
            rows, self._arrived = self._arrived, []
            return rows, self._complete

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:  # handed to the thread that takes
            self._error = error
        finally:
            self._polled.set()
            self._ready.put(None)

    def _serve(self) -> None:
        due = self._clock()
        while True:
            if self._clock() >= due:
                self._poll()
                due = self._clock() + self._settings.poll_seconds
            try:
                rows = self._asked.get(timeout=max(due - self._clock(), 0.0))
            except queue.Empty:
                continue
            memory = self._free.get() if rows is not None else None
            if rows is None or memory is None:
                return
            found = [(row, sample) for row in rows if (sample := self._sample(row)) is not None]
            for place, (_, sample) in enumerate(found):
                fill(memory, place, sample, self.spec, self.cloud)
            there, units = tuple(row for row, _ in found), tuple(sample.unit for _, sample in found)
            self._ready.put((memory.filled(there, units), memory))

    def _poll(self) -> None:
        rows = [int(row) for row in self._source.refresh()]
        gone = [int(row) for row in self._source.taken_back()]
        for row in gone:
            if row in self._cache:
                self._cached_bytes -= self._cache.pop(row).nbytes
        self._here.difference_update(gone)
        self._here.update(rows)
        self._gone.update(gone)
        self._gone.difference_update(rows)
        found = list(zip(rows, rows_held_out(self._source, rows, self._settings.hold_out), strict=True))
        with self._lock:
            self._arrived.extend(found)
            self._complete = 0 < self._source.planned() <= len(self._here) + len(self._gone)
        self._polled.set()

    def _sample(self, row: int) -> Compact | None:
        """The sample of a row; None while it is not complete."""
        if row in self._here and row not in self._cache:
            try:
                return self._read(row)
            except StoreError:
                self._poll()  # a repair may have set it aside since the last time, and a worker have rendered it again
                if row in self._here:
                    return self._read(row)
        return self._cache.get(row)

    def _read(self, row: int) -> Compact:
        sample = Compact.of(self._source.read(row), self.spec)
        if self._cached_bytes + sample.nbytes <= self._settings.cache_bytes:
            self._cache[row] = sample
            self._cached_bytes += sample.nbytes
        return sample
