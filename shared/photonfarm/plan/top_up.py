"""Top-up: more noisy passes of views that are planned already; reference images are made in the same way.

A pass is one more sample of a view, with 2 · `half_spp` samples per pixel in its two halves. New passes are numbered on
from those that are planned, so that their seeds, which follow from the number, are new; they share the stored buffers
and photons of the view and its modification. A process that loses the race for the next plan counts again.

Shape letters: V views, S samples of all plans.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from photonfarm.core.errors import SpecError
from photonfarm.core.formatting import format_count
from photonfarm.core.keys import KEY_BYTES, Key
from photonfarm.core.models import Frozen, sentences
from photonfarm.plan.hold_out import HOLD_OUT, rows_held_out
from photonfarm.plan.request import (
    MAX_SAMPLES,
    UNUSED,
    Expansion,
    PlannedContent,
    SamplesToPlan,
    expand_samples,
    sample_keys,
)
from photonfarm.scene.modification import modification_keys
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import view_keys

_A_SHARE = re.compile(r"(?:\d|\d?\.\d{1,25})(?:e-\d{1,3})?")
"""A number as Python writes one between 0 and 1, such as 0.3333333333333333 or 1e-05."""

Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


class TopUp(Frozen):
    """What to plan: more samples per pixel for each of the selected views, by so many or up to a total."""

    kind: Literal["top-up"] = "top-up"
    spp: Annotated[int, Field(ge=1, le=1 << 30)]
    adds: bool  # True: `spp` more than is planned; False: up to `spp` in all
    where: tuple[str, ...] = ()  # conditions that a view must meet, every one

    @classmethod
    def of(cls, spp: str, where: Sequence[str] = ()) -> TopUp:
        """The checked request from "+64" or "256"; raises SpecError with a sentence for each broken rule."""
        if not re.fullmatch(r"\+?\d{1,10}", spp):
            raise SpecError(f"spp = {spp!r}: write +64 for 64 more samples per pixel, or 256 for 256 in all")
        for condition in where:
            _parse_condition(condition)
        try:
            return cls(spp=int(spp), adds=spp.startswith("+"), where=tuple(where))
        except ValidationError as error:
            raise SpecError(f"the request: {'; '.join(sentences(error))}") from error

    def passes(self, spec: SceneSpec) -> int:
        """The number of passes that have `spp` samples per pixel, rounded up."""
        return -(-self.spp // spp_per_pass(spec))


def spp_per_pass(spec: SceneSpec) -> int:
    """Samples per pixel that one pass adds, both halves together."""
    return 2 * spec.transport.half_spp


def expand_top_up(
    spec: SceneSpec, request: TopUp, known: PlannedContent, *, first_job: int, shard_rows: int
) -> Expansion:
    """The rows of a request's new passes, by modification, view and pass, in jobs from number `first_job` on.

    Raises SpecError if nothing is planned or selected, or if it is too much for one request.
    """
    planned = PlannedViews.of(spec, known)
    views = np.flatnonzero(_select(planned, request.where))
    views = views[np.lexsort((planned.view_row[views], planned.modification_row[views]))]
    wanted = request.passes(spec)
    have = np.zeros_like(views) if request.adds else np.minimum(planned.passes[views], wanted)
    count = wanted - have
    if count.sum() > MAX_SAMPLES:
        raise SpecError(f"the request names {count.sum()} new samples; at most {MAX_SAMPLES} fit one request")
    candidates = _candidates(planned, views, count)
    return expand_samples(candidates, first_job=first_job, shard_rows=shard_rows, known=int(have.sum()))


def _candidates(planned: PlannedViews, views: Rows, count: Rows) -> SamplesToPlan:
    """The next `count` passes of each of some views."""
    modification_row, of_view = np.unique(planned.modification_row[views], return_inverse=True)
    modification = planned.known.vectors("modification", modification_row)
    view = planned.known.vectors("view", planned.view_row[views])
    of_sample = np.repeat(np.arange(len(views)), count)
    number = np.arange(len(of_sample)) - np.repeat(np.cumsum(count) - count, count)  # from 0 in each view
    pass_ = (planned.next_pass[views][of_sample] + number).astype(np.int32)
    keys = sample_keys(planned.spec.radiance_id, modification[of_view[of_sample]], view[of_sample], pass_)
    return SamplesToPlan(
        modification,
        modification_row,
        view,
        planned.view_row[views],
        of_view[of_sample],
        of_sample,
        pass_,
        np.frombuffer(b"".join(keys), np.uint8).reshape(-1, KEY_BYTES),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PlannedViews:
    """The views of a scene in the order of their rows, and the samples that show them."""

    spec: SceneSpec
    known: PlannedContent
    sample_row: Rows  # (S,)
    sample_view: Rows  # (S,) row of the view
    view_row: Rows  # (V,)
    modification_row: Rows  # (V,)
    passes: Rows  # (V,) how many are planned
    next_pass: Rows  # (V,)

    @classmethod
    def of(cls, spec: SceneSpec, known: PlannedContent) -> PlannedViews:
        """Count the passes of every view; raises SpecError if there is none."""
        if not known.plans:
            raise SpecError("nothing is planned that could be topped up; `photonfarm submit` plans the first samples")
        row = np.concatenate([first + np.arange(len(rows.sample_view)) for first, rows in known.plans])
        view, modification, pass_ = (known.column(f"sample_{what}") for what in ("view", "modification", "pass"))
        used = view != UNUSED
        view_row, first, of_sample = np.unique(view[used], return_index=True, return_inverse=True)
        next_pass = np.zeros(len(view_row), np.int64)
        np.maximum.at(next_pass, of_sample, pass_[used] + 1)
        passes = np.bincount(of_sample, minlength=len(view_row))
        return cls(spec, known, row[used], view[used], view_row, modification[used][first], passes, next_pass)

    def modification_keys(self, views: Rows | Mask) -> list[Key]:
        """The content key of the configuration of each of some views, by their places here."""
        rows, of_view = np.unique(self.modification_row[views], return_inverse=True)
        keys = modification_keys(self.spec.radiance_id, self.known.vectors("modification", rows))
        return [keys[m] for m in of_view.tolist()]

    def view_keys(self, views: Rows | Mask) -> list[Key]:
        """The content key of each of some views, by their places here."""
        return view_keys(self.modification_keys(views), self.known.vectors("view", self.view_row[views]))

    def are_uniform(self, views: Rows | Mask) -> list[bool]:
        """Whether each of some views, by their places here, and its configuration were drawn uniformly."""
        return self.known.are_uniform(self.modification_row[views], self.view_row[views])


# ---------------------------------------------------------------------------------------------------------- conditions


def _select(planned: PlannedViews, where: Sequence[str]) -> Mask:
    """Which of the views meet every condition; `views=first:N` counts those that meet all the others."""
    selected = np.ones(len(planned.view_row), np.bool_)
    conditions = [_parse_condition(condition) for condition in where]
    for kind, value in sorted(conditions, key=lambda condition: condition[0] == "views"):  # that one last
        match kind:
            case "views":
                selected &= np.cumsum(selected) <= value
            case "plan":
                if value >= len(planned.known.plans):
                    number = len(planned.known.plans)
                    raise SpecError(
                        f"where plan={value}: the scene has {format_count(number, 'plan')}, numbered from 0"
                    )
                first, rows = planned.known.plans[value]
                own = rows.sample_view >= first  # samples of views that the plan itself added
                selected &= np.isin(planned.view_row, rows.sample_view[own])
            case "rows":
                within = (planned.sample_row >= value[0]) & (planned.sample_row <= value[1])
                selected &= np.isin(planned.view_row, planned.sample_view[within])
            case "modification" | "view":
                # Keys take time, so only those of views that are still selected are made
                keys = planned.view_keys(selected) if kind == "view" else planned.modification_keys(selected)
                selected[selected] = [key.hex().startswith(value) for key in keys]
            case "held-out":
                selected[selected] = rows_held_out(planned, selected, value)
    if not selected.any():
        raise SpecError(f"where {' and '.join(where)}: selects none of the {len(selected)} planned views")
    return selected


def _parse_condition(condition: str) -> tuple[str, Any]:
    """The kind of a condition, as before its "=", and its value; raises SpecError for an unknown one."""
    match condition.split("="):
        case ["views" as kind, value] if re.fullmatch(r"first:[1-9]\d{0,8}", value):
            return kind, int(value.removeprefix("first:"))
        case ["plan" as kind, value] if re.fullmatch(r"\d{1,6}", value):
            return kind, int(value)
        case ["rows" as kind, value] if ends := re.fullmatch(r"(\d{1,12})(?:-(\d{1,12}))?", value):
            return kind, (int(ends[1]), int(ends[2] or ends[1]))
        case ["modification" | "view" as kind, value]:
            if re.fullmatch(r"[0-9a-f]{1,32}", value):
                return kind, value
            raise SpecError(
                f"where {condition!r}: {value!r} is no content key of a {kind}, nor how one begins: 1 to 32 "
                "hexadecimal digits, a to f in lower case"
            )
        case ["held-out" as kind]:
            return kind, HOLD_OUT
        case ["held-out" as kind, value] if _A_SHARE.fullmatch(value) and 0 < float(value) < 1:
            return kind, float(value)
    raise SpecError(
        f"where {condition!r}: is no condition; allowed are views=first:N, view=KEY, modification=KEY, rows=A-B, "
        "plan=P, held-out and held-out=SHARE"
    )
