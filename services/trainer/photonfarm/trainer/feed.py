"""A thread that follows the store and reads batches ahead, into memory that is used again and again."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from photonfarm.shared.records import BasePointCloud, Geometry
from photonfarm.trainer.dataset import Batch, Compact, SampleSource, fill, is_row_held_out
from photonfarm.trainer.settings import TrainSettings


class Feed:
    """Batches in the order they were asked for, and the rows as they arrive; a context manager.

    Only its thread touches the source. Decoded samples are kept up to `cache_bytes`: the first ones stay, since every
    sample is drawn about equally often, which is where replacing the least recently used one never hits.
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

        The second is True once everything that is planned is complete. Raises what the reading raised.
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
        seen = 0
        while True:
            if self._clock() >= due:
                seen += self._poll(seen)
                due = self._clock() + self._settings.poll_seconds
            try:
                rows = self._asked.get(timeout=max(due - self._clock(), 0.0))
            except queue.Empty:
                continue
            memory = self._free.get() if rows is not None else None
            if rows is None or memory is None:
                return
            samples = [self._sample(row) for row in rows]
            for place, sample in enumerate(samples):
                fill(memory, place, sample, self.spec, self.cloud)
            self._ready.put((memory.filled(rows, tuple(sample.unit for sample in samples)), memory))

    def _poll(self, seen: int) -> int:
        rows = self._source.refresh()
        found = [(int(row), is_row_held_out(self._source, int(row), self._settings.hold_out)) for row in rows]
        with self._lock:
            self._arrived.extend(found)
            self._complete = 0 < self._source.planned() <= seen + len(rows)
        self._polled.set()
        return len(rows)

    def _sample(self, row: int) -> Compact:
        if row in self._cache:
            return self._cache[row]
        sample = Compact.of(self._source.read(row), self.spec)
        if self._cached_bytes + sample.nbytes <= self._settings.cache_bytes:
            self._cache[row] = sample
            self._cached_bytes += sample.nbytes
        return sample
