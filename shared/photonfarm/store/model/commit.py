"""One job's outputs on their way into the store: row by row while it is rendered, and then all at once.

A thread of its own writes rows to parts that readers do not see, so that rendering does not wait for the disk; the
commit names them, makes them durable, and announces them by the job's marker.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import CorruptError, IncompleteError, store_errors
from photonfarm.core.records import F32, Guides, Photons, ViewBuffers, Visibility, arrays_of
from photonfarm.scene.poor_views import are_near, hand_of
from photonfarm.store.format import markers, schema
from photonfarm.store.format.markers import Figures
from photonfarm.store.format.shards import (
    NOISY_GUIDES,
    Shard,
    ShardWriter,
    encode,
    round_to_8_bits,
    scale_to_array,
    stays_finite,
)
from photonfarm.store.io.storage import AT_ONCE, discard, look_into
from photonfarm.store.model.findings import Cause, Finding
from photonfarm.store.model.plans import JobRows
from photonfarm.store.model.quarantine import Quarantine
from photonfarm.store.model.scene_store import SceneStore

WAITING_ROWS = 8
"""The most rows that wait to be written: more would only hide for a while that the disk is slower than the renderer."""


T = TypeVar("T")

ATTEMPTS = 3
"""The attempts to commit while other processes change the job's files; a second such change takes two attempts."""


Clock = Callable[[], datetime]


def _utc_now() -> datetime:
    return datetime.now(UTC)


class JobWriter:
    """Takes a job's rows in any order, and commits them once all are there.

    They are the radiance of its samples, buffers, guides and visibility of its new views, and photons of its new
    modifications.

    A context manager: leaving it without `commit` leaves nothing behind. Arrays must not be changed after they are
    passed. The methods raise IncompleteError for a row that is not the job's, of the wrong shape or not finite, and
    StoreError once the disk has refused something.
    """

    def __init__(self, scene: SceneStore, rows: JobRows) -> None:
        """Begin a job of a scene, with its rows."""
        self._scene = scene
        self._rows = rows
        self._plan = rows.plan
        self._storage = scene.storage
        self._arrays = schema.output_arrays(scene.spec)
        self._wanted: dict[schema.RowKind, set[int]] = rows.wanted(photons=bool(scene.spec.photons.paths))
        self._missing = {kind: set(wanted) for kind, wanted in self._wanted.items()}
        self._shards: dict[str, ShardWriter] = {}
        self._counts: Counter[str] = Counter()  # as a marker has them
        self._waiting: queue.Queue[tuple[str, int, NDArray[Any]] | None] = queue.Queue(WAITING_ROWS)
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write, daemon=True, name=f"writer of job {rows.job}")
        self._thread.start()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread and remove what is not committed; if the disk refuses, a sweep removes it later."""
        self._join()
        for shard in self._shards.values():
            with contextlib.suppress(OSError):  # the error under way states why a disk refuses
                shard.close()
            discard(shard.part)

    # ------------------------------------------------------------------------------------------------------------- rows

    def radiance(self, row: int, halves: F32) -> None:
        """Add the half-estimates A and B of a sample row, (2, H, W, 3) linear, unscaled."""
        self._claim("sample", row)
        self._counts.update(samples=1, black=int(not halves.any()))
        self._put(row, *scale_to_array(halves, self._scene.spec.radiance_exponent))

    def view(self, row: int, buffers: ViewBuffers, guides: Guides, visibility: Visibility) -> None:
        """Add a new view row: its buffers, its guides, and which points and photons it sees."""
        self._claim("view", row)
        for name, values in arrays_of(buffers).items():
            self._put(row, name, values)
        for name, values in arrays_of(guides).items():
            self._put(row, name, round_to_8_bits(values) if name in NOISY_GUIDES else values)
        self._counts.update(views=1, near=int(are_near(hand_of(self._scene.spec), buffers.depth)))
        self._put_bits(row, "point_seen", visibility.points)
        self._put_bits(row, "photon_seen", visibility.photons)

    def photons(self, row: int, photons: Photons) -> None:
        """Add the photons of a new modification row."""
        self._claim("modification", row)
        for name, values in arrays_of(photons).items():
            self._put(row, f"photon_{name}", values)

    def _put_bits(self, row: int, name: str, seen: NDArray[np.bool_]) -> None:
        count = schema.bit_counts(self._scene.spec)[name]
        if seen.shape != (count,):
            raise IncompleteError(f"{name} of row {row} has shape {seen.shape}; {(count,)} is required")
        if count:
            self._put(row, name, np.packbits(seen, bitorder="little"))

    def _claim(self, kind: schema.RowKind, row: int) -> None:
        if row not in self._missing[kind]:
            raise IncompleteError(f"{kind} {row} of job {self._rows.job}: is not the job's, or is there already")
        self._missing[kind].remove(row)

    def _put(self, row: int, name: str, values: NDArray[Any]) -> None:
        array = self._arrays[name]
        if values.shape != array.shape:
            raise IncompleteError(f"{name} of row {row} has shape {values.shape}; {array.shape} is required")
        if not stays_finite(values, array.dtype):
            raise IncompleteError(f"{name} of row {row} holds a value that is not finite in {array.dtype.name}")
        self._waiting.put((name, row % self._plan.shard_rows, values))
        self._raise_error()

    def _write(self) -> None:
        """The thread's loop: it encodes and writes rows; after an error it only empties the queue for its callers."""
        while (taken := self._waiting.get()) is not None:
            if self._error is not None:
                continue
            name, row, values = taken
            array = self._arrays[name]
            try:
                if name not in self._shards:
                    self._shards[name] = ShardWriter(self._storage.part(), array, self._plan.shard_rows)
                self._shards[name].append(row, encode(array, values))
            except Exception as error:
                self._error = error

    def _join(self) -> None:
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()

    def _raise_error(self) -> None:
        if self._error is not None:
            with self._errors():
                raise self._error

    def _errors(self) -> contextlib.AbstractContextManager[None]:
        return store_errors(f"commit job {self._rows.job}", self._storage.where)

    # ----------------------------------------------------------------------------------------------------------- commit

    def commit(self, figures: Figures, clock: Clock = _utc_now) -> bool:
        """Make the rows part of the store, all or nothing; False if the job is not to do any more.

        Another worker has committed it, say, or it was withdrawn, or its scene forgotten.

        Files that another writer left are kept if every row of the job can be read from them and from the new ones, and
        are replaced otherwise. Raises IncompleteError unless every row of the job has been given, and CorruptError if
        other writers keep changing the files. `clock` gives the time at which a marker of other files is set aside.

        Another writer of the same job may still be at work, and replace what it cannot read. Each of the two acts first
        and checks afterwards, so that one of them sees the other: whoever met a foreign file compares marker and files
        after placing the marker.
        """
        for kind, missing in self._missing.items():
            if missing:
                raise IncompleteError(f"{kind} {min(missing)} of job {self._rows.job}: is missing")
        self._join()
        self._raise_error()
        figures = figures.model_copy(update={"counts": dict(self._counts)})
        with self._errors():
            ours = {name: shard.finish() for name, shard in self._shards.items()}
            for _ in range(ATTEMPTS):
                if not self._scene.is_still_to_do(self._rows):
                    return False
                alone = self._adopt_all()
                if alone is None:
                    return False
                described = ours if alone else self._summaries()
                self._storage.settle([self._file(name) for name in described])
                if not alone and not (self._is_readable() and self._summaries() == described):
                    continue
                files = {self._plan_file(name): about for name, about in described.items()}
                placed = markers.place_marker(self._storage, self._scene.name, self._rows.job, files, figures)
                if self._scene.is_forgotten(self._rows):  # while this process was suspended: nothing here is the plan's
                    for name in (*map(self._file, described), markers.marker_name(self._scene.name, self._rows.job)):
                        self._storage.delete(name)
                    return False
                if (placed and alone) or self._is_marker_right(clock):
                    return placed
            raise CorruptError(
                f"{self._storage.where}/{self._scene.name}: the files of job {self._rows.job} change while it is "
                "committed, by another worker; it is not committed"
            )

    def _adopt_all(self) -> bool | None:
        """Give every row of the job its name; returns whether all files are new ones, None if the job is committed."""
        self._storage.require()  # a store that is gone has lost the parts too, which would look like a failed adoption
        left = [name for name, shard in self._shards.items() if shard.part.exists()]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            kept = [name for name, adopted in zip(left, pool.map(self._adopt, left), strict=True) if not adopted]
        others = [name for name in self._arrays if name not in self._shards and self._storage.exists(self._file(name))]
        if not kept and not others and len(left) == len(self._shards):
            return True
        if not self._is_readable():
            # of a writer that died, damaged, or split otherwise between float16 and float32
            if self._scene.is_committed(self._rows.job):
                return None
            for name in kept:
                self._adopt(name, replace=True)
            self._check_readable()
        return False

    def _adopt(self, name: str, *, replace: bool = False) -> bool:
        return self._storage.adopt(self._shards[name].part, self._file(name), replace=replace)

    def _summaries(self) -> dict[str, dict[str, Any]]:
        """The size and checksum of each file that is there, by array; unreadable ones are left out."""
        summaries = {}
        for name in self._arrays:
            if self._storage.exists(self._file(name)):
                with contextlib.suppress(CorruptError):
                    summaries[name] = self._look(name, Shard.summary)
        return summaries

    def _is_marker_right(self, clock: Clock) -> bool:
        """Whether the job's marker, ours or not, matches the files that are there; one that does not is set aside.

        A file that the marker does not name does no harm: it is from a late writer whose render needed float32. Of the
        two arrays only `radiance` would then be read instead of `radiance_wide`.
        """
        name = markers.marker_name(self._scene.name, self._rows.job)
        try:
            marker = self._storage.read(name)
        except FileNotFoundError:  # another writer has set it aside
            return False
        named = markers.parse_marker(marker, self._rows.job, f"{self._storage.where}/{name}")["files"]
        wrong = self._mismatched(named)
        renewed = [self._storage.renew(self._file(name)) for name in wrong]  # all of them, damaged or not
        if any(renewed):
            wrong = self._mismatched(named)
        if not wrong:
            return True
        detail = "files were replaced while the job was committed; those that are there stay"
        why = Finding(Cause.CHECKSUM, detail, self._scene.scene_id, self._rows.job, file=name)
        when = clock().isoformat(timespec="seconds")
        Quarantine(self._storage, when).job(self._scene.name, self._rows.job, marker, [], [why])
        return False

    def _mismatched(self, named: Mapping[str, Mapping[str, Any]]) -> list[str]:
        """The arrays whose files differ from the marker."""
        there = self._summaries()
        relevant = [name for name in self._arrays if name == "radiance" or self._plan_file(name) in named]
        return [name for name in relevant if not _matches(named.get(self._plan_file(name)), there.get(name))]

    def _plan_file(self, name: str) -> str:
        return self._file(name).removeprefix(f"{self._scene.name}/")

    def _file(self, name: str) -> str:
        return self._plan.shard(name, self._arrays[name], self._rows.job)

    def _look(self, name: str, look: Callable[[Shard], T]) -> T:
        """Apply `look` to an array's file; in a bucket, to a new copy if this machine's is damaged."""
        array, rows = self._arrays[name], self._plan.shard_rows
        return look_into(self._storage, self._file(name), lambda file: look(Shard(file, array, rows)))

    def _is_readable(self) -> bool:
        try:
            self._check_readable()
        except CorruptError:
            return False
        return True

    def _check_readable(self) -> None:
        """Read every row of the job from the files that are there; raises CorruptError if one is damaged or missing."""
        for name, array in self._arrays.items():
            if array.kind != "sample":
                self._check_rows(name, self._wanted[array.kind])
        samples = self._wanted["sample"]
        if self._storage.exists(self._file("radiance")):
            samples = self._check_rows("radiance", samples, may_be_missing=True)
        self._check_rows("radiance_wide", samples)

    def _check_rows(self, name: str, wanted: Set[int], *, may_be_missing: bool = False) -> set[int]:
        """Check the rows of one shard; returns the missing ones if they may be missing, else raises CorruptError."""
        if not wanted:
            return set()
        rows = self._plan.shard_rows
        missing = self._look(name, lambda shard: {row for row in wanted if shard.read(row % rows) is None})
        if missing and not may_be_missing:
            raise CorruptError(f"{self._storage.where}/{self._file(name)}: row {min(missing)} is missing")
        return missing


def _matches(named: Mapping[str, Any] | None, there: Mapping[str, Any] | None) -> bool:
    """Whether a marker's entry matches a file: the same size and checksum, or neither exists."""
    return named == there if named is None or there is None else all(named[key] == there[key] for key in there)
