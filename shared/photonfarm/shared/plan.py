"""A request for samples, expanded into rows and jobs, without what is planned already.

Shape letters: R rows of a plan, G movable groups. J is `shard_rows`, the samples of one job.

A request names every combination of its modifications, of `views_per_modification` views of each, and of `passes` noisy
passes of each view. Configurations that come out equal (both objects removed, say) are one modification with
as many views more, so that no view is drawn twice and the share of each configuration among the samples stays that
of the sampling. In particular a static scene has one modification, and `modifications` × `views_per_modification`
different views of it.

The views of a configuration are numbered from 0; growing any number of a request therefore names a superset of the
old samples, and only the new ones are planned. New views and passes refer to the rows that are there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from photonfarm.shared.errors import SpecError
from photonfarm.shared.keys import KEY_BYTES, Key, make_key
from photonfarm.shared.modification import Modification, rest, sample_modification
from photonfarm.shared.records import F32
from photonfarm.shared.scene import Frozen, SceneSpec, sentences
from photonfarm.shared.view import sample_view

SHARD_ROWS = 32
"""Samples per job, where neither the caller nor an older plan of the scene says otherwise."""

MAX_SHARD_ROWS = 4096
MAX_SAMPLES = 10_000_000
"""Samples of one request: its plan is held in memory, at about 0.2 kB each."""

UNUSED = -1
"""A row reference of a row that holds nothing."""

Count = Annotated[int, Field(ge=1, le=MAX_SAMPLES)]


class Request(Frozen):
    """What to plan: modifications × views × passes, under one master seed."""

    modifications: Count = 1
    views_per_modification: Count = 1
    passes: Annotated[int, Field(ge=1, le=65536)] = 1
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0

    @model_validator(mode="after")
    def _is_not_too_large(self) -> Self:
        if self.samples > MAX_SAMPLES:
            raise ValueError(f"names {self.samples} samples; at most {MAX_SAMPLES} fit one request")
        return self

    @property
    def samples(self) -> int:
        """How many samples it names, planned already or not."""
        return self.modifications * self.views_per_modification * self.passes

    @classmethod
    def of(cls, **values: Any) -> Request:
        """The checked request; raises SpecError with a sentence for each broken rule."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SpecError(f"the request: {'; '.join(sentences(error))}") from error


@dataclass(frozen=True, slots=True, eq=False)
class PlannedRows:
    """The inputs of a plan, R rows each; row numbers run through all plans of a scene."""

    modification: F32  # (R, G, 4) modification vectors; NaN where no modification has its row
    view: F32  # (R, 6) origin and look-at point; NaN where no view has its row
    sample_modification: NDArray[np.int64]  # (R,) row of the sample's modification, or UNUSED
    sample_view: NDArray[np.int64]  # (R,) row of the sample's view, or UNUSED
    sample_pass: NDArray[np.int32]  # (R,) pass number, or UNUSED
    sample_key: NDArray[np.uint8]  # (R, 16)

    @classmethod
    def empty(cls, rows: int, groups: int) -> PlannedRows:
        """Rows that hold nothing yet."""
        return cls(
            np.full((rows, groups, 4), np.nan, np.float32),
            np.full((rows, 6), np.nan, np.float32),
            np.full(rows, UNUSED, np.int64),
            np.full(rows, UNUSED, np.int64),
            np.full(rows, UNUSED, np.int32),
            np.zeros((rows, KEY_BYTES), np.uint8),
        )


@dataclass(frozen=True, slots=True)
class Known:
    """What the older plans of a scene hold, for lookup by content."""

    modifications: dict[bytes, int] = field(default_factory=dict)  # bytes of the vector → row
    views: dict[tuple[int, bytes], int] = field(default_factory=dict)  # modification row, bytes of the vector → row
    samples: set[Key] = field(default_factory=set)

    def add(self, rows: PlannedRows, first_row: int) -> None:
        """Take in the rows of one more plan, whose first row has the number `first_row`."""
        used = np.flatnonzero(rows.sample_modification != UNUSED)
        end = first_row + len(rows.sample_modification)
        for row in _own(rows.sample_modification[used], first_row, end):
            self.modifications.setdefault(rows.modification[row - first_row].tobytes(), row)
        views, first = np.unique(rows.sample_view[used], return_index=True)
        for row, sample in zip(views.tolist(), used[first].tolist(), strict=True):
            if first_row <= row < end:
                modification_row = int(rows.sample_modification[sample])
                self.views.setdefault((modification_row, rows.view[row - first_row].tobytes()), row)
        self.samples.update(key.tobytes() for key in rows.sample_key[used])


def _own(references: NDArray[np.int64], first_row: int, end: int) -> list[int]:
    rows = np.unique(references)
    return rows[(rows >= first_row) & (rows < end)].tolist()


@dataclass(frozen=True, slots=True)
class Expansion:
    """A request as rows: `rows` is None where nothing of it is new."""

    rows: PlannedRows | None
    new: int  # samples
    known: int  # samples named by the request and planned already


def expand(spec: SceneSpec, request: Request, known: Known, *, first_job: int, shard_rows: int) -> Expansion:
    """The rows of a request's new samples, packed into jobs of `shard_rows` from number `first_job` on.

    Samples are ordered by modification, view and pass. A new modification or view gets the next free row of its kind in
    the job of its first sample; so does everything that a job must render lie in the job's own rows.
    """
    new = [sample for sample in _samples(spec, request) if sample.key not in known.samples]
    if not new:
        return Expansion(None, 0, request.samples)
    jobs = -(-len(new) // shard_rows)
    rows = PlannedRows.empty(jobs * shard_rows, len(spec.groups))
    packing = _Packing(rows, known, first_job * shard_rows, shard_rows)
    for sample in new:
        packing.place(sample)
    return Expansion(rows, len(new), request.samples - len(new))


@dataclass(frozen=True, slots=True)
class _Sample:
    modification: F32  # (G, 4)
    view: F32  # (6,)
    pass_: int
    key: Key


def _samples(spec: SceneSpec, request: Request) -> Iterator[_Sample]:
    """Every sample of a request, by modification, view and pass; the same one never twice."""
    for modification, views in _configurations(spec, request):
        modification_key = modification.key(spec.scene_id)
        for index in views:
            view = sample_view(spec, modification_key, request.seed, index)
            for pass_ in range(request.passes):
                yield _Sample(
                    modification.vector, view.vector, pass_, sample_key(spec.scene_id, modification, view.vector, pass_)
                )


def sample_key(scene_id: str, modification: Modification, view: F32, pass_: int) -> Key:
    """The content key of one sample; `view` is the view's vector (6,)."""
    return make_key("sample", scene_id, modification.vector, view, pass_)


def _configurations(spec: SceneSpec, request: Request) -> Iterator[tuple[Modification, range]]:
    """The distinct configurations of a request in order of appearance, each with the indices of its views.

    The n-th appearance of a configuration, stands for views n·V … n·V + V − 1 of it.
    """
    each = request.views_per_modification
    if not spec.groups:
        yield rest(spec), range(request.modifications * each)
        return
    counts: dict[bytes, int] = {}
    found: dict[bytes, Modification] = {}
    for index in range(request.modifications):
        modification = sample_modification(spec, request.seed, index)
        content = modification.vector.tobytes()
        counts[content] = counts.get(content, 0) + 1
        found.setdefault(content, modification)
    for content, modification in found.items():
        yield modification, range(counts[content] * each)


class _Packing:
    """Places samples one after the other, and what they are the first to need with them."""

    def __init__(self, rows: PlannedRows, known: Known, first_row: int, shard_rows: int) -> None:
        self.rows = rows
        self.first_row = first_row
        self.shard_rows = shard_rows
        self.modifications = dict(known.modifications)
        self.views = dict(known.views)
        self.count = 0
        self.next_modification = self.next_view = first_row

    def place(self, sample: _Sample) -> None:
        if self.count % self.shard_rows == 0:  # a new job starts
            self.next_modification = self.next_view = self.first_row + self.count
        modification = self._modification_row(sample.modification)
        self.rows.sample_modification[self.count] = modification
        self.rows.sample_view[self.count] = self._view_row(modification, sample.view)
        self.rows.sample_pass[self.count] = sample.pass_
        self.rows.sample_key[self.count] = np.frombuffer(sample.key, np.uint8)
        self.count += 1

    def _modification_row(self, vector: F32) -> int:
        row = self.modifications.setdefault(vector.tobytes(), self.next_modification)
        if row == self.next_modification:
            self.rows.modification[row - self.first_row] = vector
            self.next_modification += 1
        return row

    def _view_row(self, modification_row: int, vector: F32) -> int:
        row = self.views.setdefault((modification_row, vector.tobytes()), self.next_view)
        if row == self.next_view:
            self.rows.view[row - self.first_row] = vector
            self.next_view += 1
        return row
