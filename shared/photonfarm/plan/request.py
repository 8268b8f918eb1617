"""A request for samples, expanded into rows and jobs, without what is planned already; and samples of another store.

Shape letters: R rows of a plan, G movable groups, C columns of modification vectors, D columns of view vectors.

A request names every combination of its modifications, of `views_per_modification` views of each, and of `passes` noisy
passes of each view. Configurations that come out equal (both objects removed, say) are one modification, which gets the
views of all of them: no view is drawn twice, and each configuration keeps the share of samples that it was drawn with.
So a static scene has one modification, and `modifications` × `views_per_modification` different views of it. Views that
come out equal, since the spec fixes the camera, are one view: no sample is planned twice.

The views of a configuration are numbered from 0, so growing any number of a request names a superset of the old
samples, and only the new ones are planned. New views and passes refer to the rows that are there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import KEY_BYTES, Key, make_key
from photonfarm.core.models import Frozen, sentences
from photonfarm.core.records import F32
from photonfarm.scene.modification import FIELDS, Modification, modification_keys, rest, sample_modifications
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import AXES, sample_views

SHARD_ROWS = 32
"""The default number of samples per job, if neither the caller nor an older plan of the scene sets it."""

MAX_SHARD_ROWS = 4096
MAX_SAMPLES = 1_000_000
"""The most samples of one request: its plan is made in memory, at some 0.5 to 1 kB each, more with many groups."""

UNUSED = -1
"""The reference in rows that hold nothing."""

SampleCount = Annotated[int, Field(ge=1, le=MAX_SAMPLES)]


@dataclass(frozen=True, slots=True)
class Extent:
    """What is rendered for new samples, apart from their radiance."""

    configurations: int = 0  # of the samples, new or not
    modifications: int = 0  # the new ones among them: their photons are stored
    views: int = 0  # new ones: their buffers are stored


class Request(Frozen):
    """What to plan: modifications × views × passes, under one master seed."""

    kind: Literal["samples"] = "samples"  # distinguishes it from other requests in the store
    modifications: SampleCount = 1
    views_per_modification: SampleCount = 1
    passes: Annotated[int, Field(ge=1, le=65536)] = 1
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0

    @model_validator(mode="after")
    def _is_not_too_large(self) -> Self:
        if self.samples > MAX_SAMPLES:
            raise ValueError(f"names {self.samples} samples; at most {MAX_SAMPLES} fit one request")
        return self

    @property
    def samples(self) -> int:
        """The number of samples it names, planned already or not."""
        return self.modifications * self.views_per_modification * self.passes

    def extent(self, spec: SceneSpec) -> Extent:
        """The extent of the request in a scene without plans, if no two of its configurations are equal."""
        configurations = self.modifications if spec.groups else 1
        return Extent(configurations, configurations, self.modifications * self.views_per_modification)

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

    modification: F32  # (R, G, C) modification vectors; NaN where no modification has its row
    view: F32  # (R, D) view vectors; NaN where no view has its row
    sample_modification: NDArray[np.int64]  # (R,) row of the sample's modification, or UNUSED
    sample_view: NDArray[np.int64]  # (R,) row of the sample's view, or UNUSED
    sample_pass: NDArray[np.int32]  # (R,) pass number, or UNUSED
    sample_key: NDArray[np.uint8]  # (R, 16)
    modification_density: F32  # (R,) of the configuration, over that of uniform draws from the spec; NaN: unused row
    view_density: F32  # (R,) likewise of the view, given the configuration

    @classmethod
    def empty(cls, rows: int, groups: int, columns: int = len(FIELDS), view_columns: int = len(AXES)) -> PlannedRows:
        """Rows that hold nothing yet."""
        return cls(
            np.full((rows, groups, columns), np.nan, np.float32),
            np.full((rows, view_columns), np.nan, np.float32),
            np.full(rows, UNUSED, np.int64),
            np.full(rows, UNUSED, np.int64),
            np.full(rows, UNUSED, np.int32),
            np.zeros((rows, KEY_BYTES), np.uint8),
            np.full(rows, np.nan, np.float32),
            np.full(rows, np.nan, np.float32),
        )

    def without(self, spans: Iterable[range]) -> PlannedRows:
        """The same rows, but for some spans, which hold nothing."""
        left = PlannedRows(*(getattr(self, each.name).copy() for each in fields(self)))
        columns = *self.modification.shape[1:], self.view.shape[1]
        for span in spans:
            nothing = PlannedRows.empty(len(span), *columns)
            for each in fields(self):
                getattr(left, each.name)[span.start : span.stop] = getattr(nothing, each.name)
        return left


class PlannedContent:
    """The content of a scene's older plans, for lookup; each table is built at its first use."""

    def __init__(self, plans: Iterable[tuple[int, PlannedRows]] = ()) -> None:
        """Take the plans in their order, each with the number of its first row."""
        self.plans = list(plans)

    @cached_property
    def modifications(self) -> dict[bytes, int]:
        """The row of each modification, by the bytes of its vector."""
        table: dict[bytes, int] = {}
        for first_row, rows in self.plans:
            row, _ = _own(rows.sample_modification, first_row)
            _add(table, contents(rows.modification[row - first_row]), row)
        return table

    @cached_property
    def views(self) -> dict[bytes, int]:
        """The row of each view, by its `view_contents`."""
        table: dict[bytes, int] = {}
        for first_row, rows in self.plans:
            row, sample = _own(rows.sample_view, first_row)
            _add(table, view_contents(rows.sample_modification[sample], rows.view[row - first_row]), row)
        return table

    @cached_property
    def samples(self) -> set[Key]:
        """The keys of all samples."""
        used = (rows.sample_key[rows.sample_modification != UNUSED] for _, rows in self.plans)
        return {key.tobytes() for keys in used for key in keys}

    @cached_property
    def _densities(self) -> tuple[F32, F32]:
        return self.column("modification_density"), self.column("view_density")

    def column(self, name: str) -> NDArray[Any]:
        """One input of all rows."""
        return np.concatenate([getattr(rows, name) for _, rows in self.plans])

    def are_uniform(self, modification_rows: NDArray[np.int64], view_rows: NDArray[np.int64]) -> list[bool]:
        """Whether configurations and views in pairs of rows, (N,) each, were drawn uniformly: both densities are 1."""
        if not self.plans:
            return []
        modification, view = self._densities
        uniform: list[bool] = ((modification[modification_rows] == 1) & (view[view_rows] == 1)).tolist()
        return uniform

    def vectors(self, kind: Literal["modification", "view"], rows: NDArray[np.int64]) -> F32:
        """The vectors in some rows of modifications, (N, G, C), or of views, (N, D)."""
        first_rows = np.array([first_row for first_row, _ in self.plans])
        of_row = np.searchsorted(first_rows, rows, side="right") - 1
        vectors = np.empty((len(rows), *getattr(self.plans[0][1], kind).shape[1:]), np.float32)
        order = np.argsort(of_row, kind="stable")  # by plan: each is looked into once, for its own rows alone
        numbers, first = np.unique(of_row[order], return_index=True)
        for number, own in zip(numbers.tolist(), np.split(order, first[1:]), strict=bool(len(rows))):
            first_row, inputs = self.plans[number]
            vectors[own] = getattr(inputs, kind)[rows[own] - first_row]
        return vectors


def _add(table: dict[bytes, int], keys: Iterable[bytes], rows: NDArray[np.int64]) -> None:
    for key, row in zip(keys, rows.tolist(), strict=True):
        table.setdefault(key, row)


def _look_up(table: dict[bytes, int], keys: Iterable[bytes]) -> NDArray[np.int64]:
    """The row of each key, or UNUSED."""
    return np.array([table.get(key, UNUSED) for key in keys], np.int64)


def _own(references: NDArray[np.int64], first_row: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The distinct rows of a plan that its own samples refer to, and the first sample that does."""
    rows, first = np.unique(references, return_index=True)
    own = (rows >= first_row) & (rows < first_row + len(references))
    return rows[own], first[own]


def view_contents(modification_rows: NDArray[np.int64], views: F32) -> list[bytes]:
    """The lookup keys of views (N, D), given the rows (N,) of their modifications."""
    rows = modification_rows.astype("<i8").tobytes()
    return [rows[8 * i : 8 * i + 8] + view for i, view in enumerate(contents(views))]


@dataclass(frozen=True, slots=True, eq=False)
class SamplesToPlan:
    """Samples to plan, ordered by modification, view and pass; M modifications, V views, S samples."""

    modification: F32  # (M, G, C)
    modification_row: NDArray[np.int64]  # (M,) the row of one that is planned already, or UNUSED
    view: F32  # (V, D)
    view_row: NDArray[np.int64]  # (V,) the row of one that is planned already, or UNUSED
    sample_modification: NDArray[np.int64]  # (S,) which of the modifications
    sample_view: NDArray[np.int64]  # (S,) which of the views
    sample_pass: NDArray[np.int32]  # (S,)
    sample_key: NDArray[np.uint8]  # (S, 16)
    modification_density: F32 | None = None  # (M,) as in `PlannedRows`; None: 1
    view_density: F32 | None = None  # (V,)


@dataclass(frozen=True, slots=True)
class Expansion:
    """A request as rows: `rows` is None where nothing of it is new."""

    rows: PlannedRows | None
    new: int  # samples
    known: int  # samples named by the request and planned already
    extent: Extent  # of the new samples


def expand(spec: SceneSpec, request: Request, known: PlannedContent, *, first_job: int, shard_rows: int) -> Expansion:
    """The rows of a request's new samples, packed into jobs of `shard_rows` from number `first_job` on.

    Samples are ordered by modification, view and pass.
    """
    modifications, counts = _configurations(spec, request)
    of_view = np.repeat(np.arange(len(counts)), counts)
    index = np.arange(len(of_view)) - np.repeat(np.cumsum(counts) - counts, counts)
    keys = modification_keys(spec.radiance_id, modifications)
    views = sample_views(
        spec, [keys[m] for m in of_view.tolist()], request.seed, index.tolist(), modifications[of_view]
    )
    numbers = {"first_job": first_job, "shard_rows": shard_rows}
    return expand_views(spec, modifications, of_view, views, request.passes, known, density=1.0, **numbers)


def expand_views(
    spec: SceneSpec,
    modifications: F32,
    of_view: NDArray[np.int64],
    views: F32,
    passes: int,
    known: PlannedContent,
    *,
    density: float,
    first_job: int,
    shard_rows: int,
) -> Expansion:
    """The rows of what is new of so many passes of views (V, D), in the order of their modifications (V,) of (M, G, C).

    `density` is that of all of them, as `PlannedRows` has it; a static scene's only configuration has 1.
    """
    modification_row = _look_up(known.modifications, contents(modifications))
    view_row = _look_up(known.views, view_contents(modification_row[of_view], views))

    view = np.repeat(np.arange(len(views)), passes)
    pass_ = np.tile(np.arange(passes, dtype=np.int32), len(views))
    keys = sample_keys(spec.radiance_id, modifications[of_view[view]], views[view], pass_)
    distinct = dict(zip(reversed(keys), range(len(view) - 1, -1, -1), strict=True))  # the first one stays
    new = np.array(sorted(i for key, i in distinct.items() if key not in known.samples), np.int64)
    candidates = SamplesToPlan(
        modifications,
        modification_row,
        views,
        view_row,
        of_view[view[new]],
        view[new],
        pass_[new],
        np.frombuffer(b"".join(keys[i] for i in new.tolist()), np.uint8).reshape(-1, KEY_BYTES),
        np.full(len(modifications), density if spec.groups else 1, np.float32),
        np.full(len(views), density, np.float32),
    )
    planned = len(distinct) - len(new)
    return expand_samples(candidates, first_job=first_job, shard_rows=shard_rows, known=planned)


def sample_keys(radiance_id: str, modifications: F32, views: F32, passes: Iterable[int]) -> list[Key]:
    """The content keys of samples of configurations (N, G, C) and views (N, D), by the numbers of their passes (N,)."""
    samples = zip(modifications, views, passes, strict=True)
    return [make_key("sample", radiance_id, modification, view, int(pass_)) for modification, view, pass_ in samples]


def sample_key(radiance_id: str, modification: Modification, view: F32, pass_: int) -> Key:
    """The content key of one sample; `view` is the view's vector (D,)."""
    return sample_keys(radiance_id, modification.vector[None], view[None], [pass_])[0]


def contents(array: F32) -> list[bytes]:
    """The bytes of each row of an array, little-endian."""
    return [row.tobytes() for row in np.ascontiguousarray(array, "<f4")]


def _configurations(spec: SceneSpec, request: Request) -> tuple[F32, NDArray[np.int64]]:
    """The distinct configurations of a request in order of appearance (M, G, C), each with its number of views (M,).

    The n-th appearance of a configuration stands for views n·V … n·V + V − 1 of it.
    """
    each = request.views_per_modification
    if not spec.groups:
        return rest(spec).vector[None], np.array([request.modifications * each])
    vectors = sample_modifications(spec, request.seed, range(request.modifications))
    counts = Counter(contents(vectors))
    distinct = np.frombuffer(b"".join(counts), "<f4").reshape(-1, *vectors.shape[1:])
    return distinct.astype(np.float32), each * np.array(list(counts.values()), np.int64)


def expand_samples(samples: SamplesToPlan, *, first_job: int, shard_rows: int, known: int = 0) -> Expansion:
    """The rows of new samples, in their order, in jobs from number `first_job` on; `known` others are planned already.

    A new modification or view gets the next free row of its kind in the job of its first sample; so everything that a
    job must render lies in its own rows.
    """
    count, first_row = len(samples.sample_pass), first_job * shard_rows
    if not count:
        return Expansion(None, 0, known, Extent())
    columns = *samples.modification.shape[1:], samples.view.shape[1]
    rows = PlannedRows.empty(-(-count // shard_rows) * shard_rows, *columns)
    modification_row, modified = _place(samples.sample_modification, samples.modification_row, first_row, shard_rows)
    rows.modification[modification_row[modified] - first_row] = samples.modification[modified]
    density = samples.modification_density
    rows.modification_density[modification_row[modified] - first_row] = 1 if density is None else density[modified]
    view_row, seen = _place(samples.sample_view, samples.view_row, first_row, shard_rows)
    rows.view[view_row[seen] - first_row] = samples.view[seen]
    density = samples.view_density
    rows.view_density[view_row[seen] - first_row] = 1 if density is None else density[seen]
    rows.sample_modification[:count] = modification_row[samples.sample_modification]
    rows.sample_view[:count] = view_row[samples.sample_view]
    rows.sample_pass[:count] = samples.sample_pass
    rows.sample_key[:count] = samples.sample_key
    configurations = len(np.unique(samples.sample_modification))
    return Expansion(rows, count, known, Extent(configurations, len(modified), len(seen)))


def _place(
    references: NDArray[np.int64], known_row: NDArray[np.int64], first_row: int, shard_rows: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The row of each thing that samples refer to, and which of the things are new.

    A new one takes the next free row in the job of the first sample that refers to it.
    """
    thing, sample = np.unique(references, return_index=True)
    order = np.argsort(sample)
    thing, sample = thing[order], sample[order]
    new = known_row[thing] == UNUSED
    thing, job = thing[new], sample[new] // shard_rows
    before = np.searchsorted(job, job)  # new things of earlier jobs: `job` ascends
    rows = known_row.copy()
    rows[thing] = first_row + job * shard_rows + np.arange(len(thing)) - before
    return rows, thing


class Joined(Frozen):
    """What a plan of a join holds: samples that another store had. Its rows cannot be made from this alone."""

    kind: Literal["join"] = "join"
    store: str  # id of the other store
    samples: Annotated[int, Field(ge=1)]


def samples_to_join(other: PlannedContent, rows: NDArray[np.int64], known: PlannedContent) -> SamplesToPlan:
    """The samples in some rows of another store's plans that are not `known` in this one, in the order of the rows.

    Configurations and views that are known here keep the rows that they have here.
    """
    keys = other.column("sample_key")[rows]
    new = np.array([key.tobytes() not in known.samples for key in keys], np.bool_)
    rows, keys = rows[new], keys[new]
    modification_row, of_modification = np.unique(other.column("sample_modification")[rows], return_inverse=True)
    view_row, first, of_view = np.unique(other.column("sample_view")[rows], return_index=True, return_inverse=True)
    modification, view = other.vectors("modification", modification_row), other.vectors("view", view_row)
    here = _look_up(known.modifications, contents(modification))
    return SamplesToPlan(
        modification,
        here,
        view,
        _look_up(known.views, view_contents(here[of_modification[first]], view)),
        of_modification,
        of_view,
        other.column("sample_pass")[rows],
        keys.reshape(-1, KEY_BYTES),
        other.column("modification_density")[modification_row],
        other.column("view_density")[view_row],
    )
