"""A thread that follows a scene's samples and reads batches ahead, into memory that is reused."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.errors import IncompleteError
from photonfarm.core.keys import Key, Stream
from photonfarm.core.records import F32
from photonfarm.core.waiting import pause_after_look
from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.plan.hold_out import Side, enough, sides_of, units_of
from photonfarm.scene.poor_views import are_near, hand_of, is_unlit
from photonfarm.store import SceneReader
from photonfarm.store.read.batch import Batch
from photonfarm.trainer.data.batch import ResidentSamples, TrainingBatch, allocate_memory, choose_kept_pixels
from photonfarm.trainer.networks import find_needs
from photonfarm.trainer.networks.inputs import Needs, NoisyColour
from photonfarm.trainer.runs.devices import usable_device
from photonfarm.trainer.runs.settings import TrainSettings

LATE_S = 60.0
"""The seconds within which a row that another process has seen complete is complete here too."""

NAP_S = 0.05

Request = tuple[int, ...] | Callable[[], object] | None
"""The rows of a batch; what is to be done between two batches; or the end."""


class Feed:
    """Batches in the order of their requests, and rows as they arrive; a context manager.

    Only the feed's thread uses the source, but for `is_skipped`, which reads. On a CPU there is no cache of samples
    besides the batches, unless one is asked for: to read a sample from the system's cache, checked, takes less than
    half of the time to write it into a batch (docs/results/train_step.md), so that a cache would hardly be worth its
    memory.
    """

    def __init__(
        self,
        source: SceneReader,
        settings: TrainSettings,
        clock: Callable[[], float] = time.monotonic,
        needs: Needs | None = None,
        resident: ResidentSamples | None = None,
        finish: Callable[[TrainingBatch], TrainingBatch] | None = None,
    ) -> None:
        """Feed a batch with the inputs that the settings' network needs, or those in `needs`.

        With `resident`, samples are kept there, and batches are on its device. What is read is what `finish` makes of
        it.
        """
        self._finish = finish
        self._source, self._settings, self._clock = source, settings, clock
        self._needs = needs or find_needs(settings.network)
        self._resident = resident if resident is not None and resident.makes_batches else None
        self.spec, self.base = source.spec, source.base()
        points = settings.network.points
        self._dataset = SceneDataset(source, self._needs.fields, exposure=self.spec.exposure, points=points)
        self._lock = threading.Lock()
        self._arrived: list[tuple[int, Side]] = []
        self._plans: list[dict[str, Any]] = []
        self._sides: set[Side] = set()  # of samples so far
        self._units: set[Key] = set()  # what is held out as one, until some are and some are not
        self._views: dict[int, Key] = {}  # of held-out rows, by row
        self._known: set[int] = set()  # rows that have arrived
        self._skipped: dict[int, bool] = {}  # by row, of those that were asked for
        self._missing: set[int] = set()  # rows that are known, and were set aside and are not complete again yet
        self._complete = False
        self._error: BaseException | None = None
        pinned = usable_device(settings.device).type == "cuda"
        self._asked: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[tuple[TrainingBatch, dict[str, Tensor]] | None] = queue.SimpleQueue()
        self._free: queue.SimpleQueue[dict[str, Tensor] | None] = queue.SimpleQueue()
        for _ in range(settings.prefetch + 1):
            self._free.put(allocate_memory(self._dataset.tensors, settings.batch, pinned=pinned))
        self._lent: dict[str, Tensor] | None = None
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

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Read nothing during the block, which begins once all requested batches are read; then look what is `missing`.

        At most `prefetch` batches may be requested. Raises the errors of reading.
        """
        begun, over, looked = threading.Event(), threading.Event(), threading.Event()

        def rest() -> None:
            begun.set()
            over.wait()
            self._look_anew()
            looked.set()

        self._asked.put(rest)
        self._wait_for(begun)
        try:
            yield
        finally:
            over.set()
        self._wait_for(looked)

    def expect(self, rows: Iterable[int]) -> None:
        """Take rows as known that an earlier session has trained on, and look which samples are `missing`."""
        self._asked.put(lambda: self._known.update(rows))
        with self.quiet():
            pass

    def _wait_for(self, event: threading.Event) -> None:
        while not event.wait(NAP_S):
            self._raise()

    @property
    def missing(self) -> int:
        """The number of samples that had arrived, and were not complete at the last look. Raises errors of reading."""
        self._raise()
        return len(self._missing)

    def arrivals(self) -> tuple[list[tuple[int, Side]], bool]:
        """The rows that became complete since the last call, each with its side; and whether all have.

        Raises the errors of reading.
        """
        self._raise()
        with self._lock:
            rows, self._arrived = self._arrived, []
            return rows, self._complete

    def first_of_views(self, rows: Iterable[int]) -> list[int]:
        """The first sample of each view among held-out rows that have arrived, in the order of their views' arrival."""
        first: dict[Key, int] = {}
        with self._lock:
            for row in rows:
                key = self._views[row]
                first[key] = min(row, first.get(key, row))
        return list(first.values())

    def plan_requests(self) -> list[dict[str, Any]]:
        """The requests of all plans, as of the last look at the store."""
        with self._lock:
            return self._plans

    def other_hold_out(self) -> float | None:
        """A share that splits what has arrived, where the settings' one leaves one side empty; None if none does."""
        with self._lock:
            return enough(self._units, least=0.0)

    def is_skipped(self, row: int) -> bool:
        """Whether a row is never trained on, by `skip_views`; its sample is read for that, once."""
        kinds = self._settings.skip_views
        if kinds and row not in self._skipped:
            (sample,) = self._source.read_samples([row], Batch.empty(self.spec, 1, guides=True))
            lit_by = sample.images, sample.view.origin, sample.seen_photons, lambda: sample.photons
            is_near = "near" in kinds and bool(are_near(hand_of(self.spec), sample.images["depth"]))
            self._skipped[row] = is_near or ("unlit" in kinds and is_unlit(*lit_by))
        return bool(kinds) and self._skipped[row]

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
                asked = self._asked.get(timeout=max(due - self._clock(), 0.0))
            except queue.Empty:
                continue
            if callable(asked):
                asked()
                continue
            memory = self._free.get() if asked is not None else None
            if asked is None or memory is None:
                return
            self._ready.put((self._read(asked, memory), memory))

    def _poll(self) -> None:
        new = [int(row) for row in self._source.refresh()]
        arrived = list(zip(new, sides_of(self._source, new, self._settings.hold_out), strict=True))
        units = units_of(self._source, [row for row, side in arrived if side is not None])
        kept = [row for row, side in arrived if side == "held-out"]
        views = self._source.view_keys(kept)
        with self._lock:
            self._views.update(zip(kept, views, strict=True))
            self._arrived.extend(arrived)
            self._sides.update(side for _, side in arrived if side is not None)
            self._units = set() if len(self._sides) > 1 else self._units.union(units)
            self._plans = list(self._source.plan_requests)
            self._known.update(new)
            self._missing.difference_update(new)
            self._complete = 0 < self._source.planned <= len(self._known)
        self._polled.set()

    def _look_anew(self) -> None:
        self._source.doubt()
        self._poll()
        self._missing = self._known.difference(self._source.rows.tolist())

    def _read(self, rows: Sequence[int], memory: dict[str, Tensor]) -> TrainingBatch:
        """Read a batch; another process may have seen its rows arrive before this one has looked."""
        late = time.monotonic() + LATE_S
        while not (self._known.issuperset(rows) and self._missing.isdisjoint(rows)) and time.monotonic() < late:
            self._poll()
            time.sleep(NAP_S)
        fresh = rows if self._resident is None else self._resident.list_lacking(rows)
        batch = read_batch(self._source, self._dataset, fresh, self._needs, memory)
        if self._finish is not None and fresh:
            batch = self._finish(batch)
        return batch if self._resident is None else self._resident.batch(rows, batch)


def read_batch(
    source: SceneReader,
    dataset: SceneDataset,
    rows: Sequence[int],
    needs: Needs,
    memory: dict[str, Tensor] | None = None,
) -> TrainingBatch:
    """Read complete samples of a source by its dataset, with the noisy colour of A that is needed.

    Raises IncompleteError if a view has fewer passes than there are to be halves.
    """
    film = dataset.spec.film.height, dataset.spec.film.width
    pixels = passes = given = None
    tensors = dataset.read(rows, memory)
    if needs.kept:
        chosen = [choose_kept_pixels(key, dataset.spec, needs.kept) for key in source.sample_keys(rows)]
        pixels = torch.from_numpy(np.array(chosen, np.bool_).reshape(-1, *film))
    if needs.passes:
        samples = zip(rows, tensors["radiance"], strict=True)
        counts, variances = zip(*(_average_passes(source, dataset, *sample) for sample in samples), strict=True)
        passes = torch.tensor(counts), torch.stack(variances)
    if needs.halves > 1 and pixels is not None:
        means, variances = zip(*(_average_halves(source, row, needs.halves) for row in rows), strict=True)
        colour, count = torch.from_numpy(np.stack(means)), torch.full((len(rows),), float(needs.halves))
        given = NoisyColour(colour * pixels[..., None], pixels, count, torch.from_numpy(np.stack(variances)))
    return TrainingBatch.of(rows, units_of(source, rows), tensors, pixels, passes, given)


def _average_halves(source: SceneReader, row: int, count: int) -> tuple[F32, F32]:
    """The mean of the halves A of the first passes of a sample's view, and the variance of its mean colour.

    (H, W, 3), linear radiance × exposure, and (H, W).
    """
    passes = source.rows_of_view(source.view_row(row))[:count].tolist()
    if len(passes) < count:
        raise IncompleteError(f"row {row}: its view has {len(passes)} complete passes, and {count} halves are wanted")
    halves = np.stack([source.read_radiance(each)[0] for each in passes]) * np.float32(source.spec.exposure)
    variance = halves.mean(axis=-1, dtype=np.float64).var(axis=0, ddof=1) / count
    return halves.mean(axis=0, dtype=np.float64).astype(np.float32), variance.astype(np.float32)


def _average_passes(source: SceneReader, dataset: SceneDataset, row: int, halves: Tensor) -> tuple[float, Tensor]:
    """Replace the halves of a sample (2, H, W, 3) by their means with earlier passes of its view in the same job.

    How many these are is drawn by the sample's key: none to all. So one network learns from any number of samples. As
    a job is committed whole, the same ones are there whenever the row is read. Returns the number of passes, and the
    variance of the means of colour, (2, H, W), by which these differ.
    """
    earlier = source.earlier_passes(row)
    count = int(Stream(source.sample_keys([row])[0], "passes").uniform(1)[0] * (len(earlier) + 1))
    if not count:
        return 1.0, halves.new_zeros(halves.shape[:3])
    factor = dataset.spec.exposure
    others = [torch.from_numpy(source.read_radiance(int(each))) * factor for each in earlier[-count:]]
    passes = torch.stack([halves.clone(), *others])
    halves.copy_(passes.mean(dim=0))
    return float(len(passes)), passes.mean(dim=-1).var(dim=0) / len(passes)
