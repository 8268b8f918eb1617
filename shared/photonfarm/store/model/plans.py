"""Plans in the store: written once under another name and renamed into place, then only read.

Shape letters: R rows of a plan, J `shard_rows`. Row r of a scene belongs to job r // J.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from photonfarm.core.errors import CorruptError, SpecError, store_errors
from photonfarm.core.keys import Key
from photonfarm.core.models import sentences
from photonfarm.plan.chosen import Chosen, expand_chosen
from photonfarm.plan.request import UNUSED, Expansion, Joined, PlannedContent, PlannedRows, Request, expand
from photonfarm.plan.top_up import TopUp, expand_top_up
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store.format import declarations, markers, schema
from photonfarm.store.io.storage import Storage
from photonfarm.store.model import findings

PLANS = "plans"
NAME_DIGITS = 6

FORGOTTEN = "forgotten."
"""How the files begin that are left of a scene's plans each time when it is forgotten."""

INPUTS = [field.name for field in fields(PlannedRows)]
"""The names of a plan's arrays of inputs."""

AnyRequest: TypeAlias = Request | Chosen | TopUp | Joined

_REQUEST: TypeAdapter[AnyRequest] = TypeAdapter(Annotated[AnyRequest, Field(discriminator="kind")])


@dataclass(frozen=True, slots=True)
class PlanAttributes:
    """The attributes of a plan's group."""

    request: AnyRequest
    first_job: int
    jobs: int
    shard_rows: int
    radiance_exponent: int  # the power of two by which radiance is stored
    halves_from: str | None  # another scene, whose halves its jobs take over
    checksums: Mapping[str, str]  # of each zarr.json, by its name in the folder


@dataclass(frozen=True, slots=True, eq=False)
class StoredPlan(PlanAttributes):
    """One plan of a scene with its inputs."""

    number: int
    folder: str  # its name in the storage
    rows: PlannedRows
    withdrawn: frozenset[int] = frozenset()  # jobs whose rows count as unused
    named: int = 0  # samples that it was made with, withdrawn or not
    forgotten: int = 0  # how often the scene had been forgotten when it was made

    @property
    def end_job(self) -> int:
        """The number of the job after its last."""
        return self.first_job + self.jobs

    @property
    def first_row(self) -> int:
        """The number of its first row, in the scene."""
        return self.first_job * self.shard_rows

    @property
    def end_row(self) -> int:
        """The number of the row after its last."""
        return self.end_job * self.shard_rows

    @property
    def own_jobs(self) -> range:
        """The numbers of its jobs."""
        return range(self.first_job, self.end_job)

    @property
    def samples(self) -> int:
        """The number of samples that it holds; the rest of its last job's rows is unused."""
        return int(np.count_nonzero(self.rows.sample_modification != UNUSED))

    def samples_in(self, job: int) -> int:
        """The number of samples in one of its jobs."""
        first = (job - self.first_job) * self.shard_rows
        return int(np.count_nonzero(self.rows.sample_modification[first : first + self.shard_rows] != UNUSED))

    def shard(self, name: str, array: schema.ArraySchema, job: int) -> str:
        """The file of one job's rows of an array."""
        return f"{self.folder}/{name}/{array.shard_name(job - self.first_job)}"


@dataclass(frozen=True, slots=True)
class SampleRow:
    """The inputs of one sample."""

    row: int
    modification_row: int
    view_row: int
    pass_: int
    key: Key


@dataclass(frozen=True, slots=True, eq=False)
class JobRows:
    """What one job must produce, and every input that it refers to, also in older plans."""

    plan: StoredPlan
    job: int
    samples: tuple[SampleRow, ...]  # by modification, view and pass
    modifications: dict[int, Modification]  # by row: all that the samples refer to
    views: dict[int, View]  # by row: all that the samples refer to
    new_modifications: frozenset[int]  # rows whose photons this job produces
    new_views: frozenset[int]  # rows whose buffers this job produces

    def wanted(self, *, photons: bool = True) -> dict[schema.RowKind, set[int]]:
        """The rows that the job stores of each kind; of modifications none in a scene without `photons`."""
        modifications = set(self.new_modifications) if photons else set()
        return {
            "sample": {each.row for each in self.samples},
            "view": set(self.new_views),
            "modification": modifications,
        }


def folder(scene: str, number: int) -> str:
    """The folder of a plan, in the scene's."""
    return f"{scene}/plans/{number:0{NAME_DIGITS}d}"


def content(plans: list[StoredPlan]) -> PlannedContent:
    """The content of plans, for lookup."""
    return PlannedContent((plan.first_row, plan.rows) for plan in plans)


def expand_request(
    spec: SceneSpec, request: AnyRequest, before: list[StoredPlan], *, first_job: int, shard_rows: int
) -> Expansion:
    """The rows of a request that the earlier plans do not have: a function of these, the same each time.

    Raises SpecError for a request that cannot be met, and for that of a join, whose rows are another store's.
    """
    if isinstance(request, Joined):
        raise SpecError(f"the rows of a join are those of another store, {request.store}")
    known = content(before)
    if isinstance(request, TopUp):
        return expand_top_up(spec, request, known, first_job=first_job, shard_rows=shard_rows)
    if isinstance(request, Chosen):
        return expand_chosen(spec, request, known, first_job=first_job, shard_rows=shard_rows)
    return expand(spec, request, known, first_job=first_job, shard_rows=shard_rows)


def build(
    part: Path,
    spec: SceneSpec,
    request: AnyRequest,
    rows: PlannedRows,
    *,
    first_job: int,
    shard_rows: int,
    halves_from: str | None = None,
) -> None:
    """Write a complete plan into a new folder: its inputs, and its outputs declared at full size."""
    from photonfarm.store.format.metadata import new_group

    count = len(rows.sample_modification)
    attributes: Any = {
        **declarations.stamp(),
        "scene": spec.scene_id,
        "radiance_id": spec.radiance_id,
        "inputs_id": spec.inputs_id,
        "inputs": spec.inputs(),
        "parts": declarations.PARTS,
        "radiance_exponent": spec.radiance_exponent,
        "request": request.model_dump(mode="json"),
        "first_job": first_job,
        "jobs": count // shard_rows,
        "shard_rows": shard_rows,
        **({} if halves_from is None else {"halves_from": halves_from}),
    }
    with new_group(part, attributes) as group:
        for declared in declarations.PLAN_INPUTS:
            groups = [each.name for each in spec.groups]
            values = getattr(rows, declared.name)
            more = declarations.vector_attributes(declared.name, groups, values.shape[-1])
            schema.create_input(group, declared, values, more)
        schema.create_outputs(group, spec, count, shard_rows)


def load_all(storage: Storage, scene: str, loaded: list[StoredPlan], *, until: int | None = None) -> list[StoredPlan]:
    """The plans of a scene in order, keeping those already loaded; all, or those before `until`.

    If the scene was forgotten since some were loaded, none is kept: others may have their numbers now.
    Raises CorruptError if one is missing or is not as it was written: later rows refer to its rows, and its samples
    would be planned again without end.
    """
    with store_errors("read the plans", f"{storage.where}/{scene}"):
        names = storage.names(f"{scene}/{PLANS}")
        times = sum(name.startswith(FORGOTTEN) for name in names)
        kept = [plan for plan in loaded if plan.forgotten == times]
        end = _count_by_names(storage, scene, names, len(kept)) if until is None else until
        all_plans = kept + [replace(_load(storage, scene, n), forgotten=times) for n in range(len(kept), end)]
        for number, plan in enumerate(all_plans):
            if markers.withdrawn_file(plan.folder).rpartition("/")[2] in names:
                all_plans[number] = _without(storage, scene, plan, markers.read_withdrawn(storage, plan.folder))
        return all_plans


def _without(storage: Storage, scene: str, plan: StoredPlan, jobs: frozenset[int]) -> StoredPlan:
    """The plan with the rows of jobs as unused ones."""
    if plan.withdrawn == jobs:
        return plan
    if plan.withdrawn:  # others than now
        plan = replace(_load(storage, scene, plan.number), forgotten=plan.forgotten)
    first_rows = ((job - plan.first_job) * plan.shard_rows for job in jobs)
    rows = plan.rows.without(range(first, first + plan.shard_rows) for first in first_rows)
    return replace(plan, rows=rows, withdrawn=jobs)


def count(storage: Storage, scene: str) -> int:
    """The number of plans that a scene must have, by the last one's number.

    A last plan that is still being written does not count. This shows only in a bucket, where the folder is claimed
    first, and its zarr.json comes last.
    """
    return _count_by_names(storage, scene, storage.names(f"{scene}/{PLANS}"), 0)


def _count_by_names(storage: Storage, scene: str, names: list[str], loaded: int) -> int:
    """The number of plans by the names in their folder, as `folder` makes them; the first `loaded` are known."""
    numbers = [name for name in names if name.isascii() and name.isdecimal()]
    count = max((int(name) + 1 for name in numbers if name == f"{int(name):0{NAME_DIGITS}d}"), default=0)
    if count <= loaded:
        return loaded
    last = folder(scene, count - 1)
    is_being_written = not storage.exists(f"{last}/zarr.json") and storage.exists(f"{last}.claim")
    return count - 1 if is_being_written else count


def _load(storage: Storage, scene: str, number: int) -> StoredPlan:
    """A plan; raises CorruptError if it is missing or not as it was written."""
    name = folder(scene, number)
    group, about = open_plan(storage, name)
    with _unreadable(storage, name, remedy_for(about.request)):
        rows = PlannedRows(*(schema.read_input(storage, f"{name}/{each}", group[each]) for each in INPUTS))
    known = {each.name: getattr(about, each.name) for each in fields(about)}
    named = int(np.count_nonzero(rows.sample_modification != UNUSED))
    return StoredPlan(**known, number=number, folder=name, rows=rows, named=named)


def remedy_for(request: AnyRequest) -> str:
    """The remedy for damaged inputs of a plan."""
    return findings.rejoin(request.store) if isinstance(request, Joined) else findings.REWRITE


def open_plan(storage: Storage, name: str) -> tuple[Any, PlanAttributes]:
    """The group of the plan in a folder, and its attributes; raises CorruptError unless they are as written."""
    from photonfarm.store.format.metadata import open_group

    with _unreadable(storage, name, findings.RESTORE):
        group, checksums = open_group(storage, name)
        attributes = dict(group.attrs)
        request = _REQUEST.validate_python(attributes["request"], extra="ignore")  # a later program may add keys
        numbers = {name: int(attributes[name]) for name in ("first_job", "jobs", "shard_rows", "radiance_exponent")}
        others = attributes.get("halves_from")
        return group, PlanAttributes(request=request, **numbers, halves_from=others, checksums=checksums)


@contextlib.contextmanager
def _unreadable(storage: Storage, name: str, remedy: str) -> Iterator[None]:
    """Turn what readers of a plan raise into CorruptError."""
    try:
        yield
    except FileNotFoundError as error:
        raise CorruptError(f"{storage.where}/{name}: {findings.MISSING}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise CorruptError(f"{storage.where}/{name}: is not a readable plan: {reason(error)}; {remedy}") from error


def reason(error: Exception) -> str:
    """The reason why a plan cannot be read, in one line."""
    if isinstance(error, ValidationError):
        return "; ".join(sentences(error))
    return f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)


def plan_of(plans: list[StoredPlan], row: int) -> StoredPlan:
    """The plan that a row belongs to."""
    for plan in reversed(plans):
        if plan.first_row <= row < plan.end_row:
            return plan
    raise IndexError(f"row {row} belongs to no plan of this scene")


def modification_at(plans: list[StoredPlan], row: int) -> Modification:
    """The modification in a modification row."""
    plan = plan_of(plans, row)
    return Modification.from_vector(plan.rows.modification[row - plan.first_row])


def view_at(plans: list[StoredPlan], row: int) -> View:
    """The view in a view row."""
    plan = plan_of(plans, row)
    return View.from_vector(plan.rows.view[row - plan.first_row])


def sample_at(plans: list[StoredPlan], row: int) -> SampleRow | None:
    """The inputs of the sample in a row; None for an unused row."""
    plan = plan_of(plans, row)
    own, inputs = row - plan.first_row, plan.rows
    if inputs.sample_modification[own] == UNUSED:
        return None
    modification, view, pass_ = inputs.sample_modification[own], inputs.sample_view[own], inputs.sample_pass[own]
    return SampleRow(row, int(modification), int(view), int(pass_), inputs.sample_key[own].tobytes())


def job_rows(plans: list[StoredPlan], job: int) -> JobRows:
    """The inputs and outputs of one job; raises IndexError for a job of no plan."""
    plan = next((plan for plan in plans if job in plan.own_jobs), None)
    if plan is None:
        raise IndexError(f"job {job} belongs to no plan of this scene")
    own = range(job * plan.shard_rows, (job + 1) * plan.shard_rows)
    samples = [sample for row in own if (sample := sample_at(plans, row))]
    samples.sort(key=lambda s: (s.modification_row, s.view_row, s.pass_))
    modifications = {s.modification_row: modification_at(plans, s.modification_row) for s in samples}
    views = {s.view_row: view_at(plans, s.view_row) for s in samples}
    new = (frozenset(row for row in rows if row in own) for rows in (modifications, views))
    return JobRows(plan, job, tuple(samples), modifications, views, *new)


def complete_rows(plans: list[StoredPlan], committed: set[int]) -> NDArray[np.bool_]:
    """Whether each row of the scene holds a complete sample, (rows of all plans,).

    A sample is complete if its own job, its view's job and its modification's job are committed.
    """
    if not plans:
        return np.zeros(0, np.bool_)
    shard_rows, inputs = plans[0].shard_rows, content(plans)
    done = np.zeros(plans[-1].end_job, np.bool_)
    done[[job for job in committed if job < len(done)]] = True
    modification, view = inputs.column("sample_modification"), inputs.column("sample_view")
    own = done.repeat(shard_rows)
    return (modification != UNUSED) & own & done[view // shard_rows] & done[modification // shard_rows]
