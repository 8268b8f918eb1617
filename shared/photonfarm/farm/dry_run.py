"""What a request would plan, store and cost, and how the same cost would be spent best; nothing is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from photonfarm.core.errors import BackendError
from photonfarm.core.formatting import format_bytes, format_count
from photonfarm.core.processes import usable_cores
from photonfarm.core.waiting import format_span
from photonfarm.farm.renderer_verbs import measure_costs
from photonfarm.farm.submission import Submission, estimate_sample_seconds
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import SHARD_ROWS, Extent, Request
from photonfarm.plan.sample_costs import Allocation, CostModel, SampleCosts
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import Store
from photonfarm.store.format.schema import bytes_of_rows
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.model.plans import expand_request

LEAST_S, MOST_S, SHARE_S = 20.0, 120.0, 0.1
"""The processor seconds that measuring may take: a tenth of one for each sample that would be planned, about a tenth of
what they cost; not below 20, into which most rooms fit, nor above 120, into which all do."""

WORTH_A_CHANGE = 0.05
"""The share of the excess error that a suggestion must save: costs and noise are medians of a few views."""


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A `half_spp` and a request with less predicted error than the user's, at the same cost."""

    half_spp: int
    modifications: int | None  # None of a static scene, as its views are all that there is to choose
    views: int | None  # None in a static scene, which has only views to choose
    samples: int  # in all, of one pass each


@dataclass(frozen=True, slots=True)
class DryRun(Submission):
    """What a request would do. Fields that follow from measured costs are None without them."""

    extent: Extent = field(kw_only=True)
    size_bytes: int = field(kw_only=True)  # before compression
    workers: int | None = field(default=None, kw_only=True)  # as asked for
    cores: int = field(kw_only=True)  # one for each of these, or those of this machine that this process may use
    costs: SampleCosts | None = field(default=None, kw_only=True)
    core_s: float | None = field(default=None, kw_only=True)  # to render what would be planned
    wall_s: float | None = field(default=None, kw_only=True)  # with a worker on each of the cores
    card_s: float | None = field(default=None, kw_only=True)  # of one card, where that renders; not measured here
    reduction: float | None = field(default=None, kw_only=True)  # of the excess error, by the best of the same cost
    suggestion: Suggestion | None = field(default=None, kw_only=True)  # that allocation, if it is worth a change


def describe_roughly(spec: SceneSpec, request: Request, workers: int, *, on_cards: bool) -> str:
    """The samples of a request, their size and their time, in a line; nothing is measured, nor looked up in a store."""
    samples, seconds = request.samples, estimate_sample_seconds(spec, on_card=on_cards) * request.samples / workers
    return (
        f"{spec.name}: {format_count(samples, 'sample')}, those planned before among them; at most "
        f"{format_bytes(_size(spec, samples, request.extent(spec)))} before compression; about {format_span(seconds)} "
        f"on {format_count(workers, 'worker')}, or up to three times more or less"
    )


def _size(spec: SceneSpec, samples: int, extent: Extent) -> int:
    """The bytes of samples with their views and configurations, before compression."""
    of = bytes_of_rows(spec)
    return of["sample"] * samples + of["view"] * extent.views + of["modification"] * extent.modifications


def rehearse(
    named: NamedSpec,
    store: str | Path,
    request: Request | Chosen,
    *,
    measure: bool,
    log: Callable[[str], None],
    shard_rows: int | None = None,
    workers: int | None = None,
    on_card: bool = False,
) -> DryRun:
    """What `submission.submit` would plan, with the time of so many workers, or of this machine's cores; or of a card.

    With `measure`, also its cost, and how the same cost would be spent best; `log` is called with the reason if the
    cost is unknown. Nothing is suggested for what a person chose, and if some samples of the request are planned
    already: another half_spp makes another scene, in which all of them would be rendered again. Raises SpecError and
    StoreError as `submit` does.
    """
    spec = named.spec
    if not is_vacant(store):
        planned = Store(store).plan(spec, request, shard_rows=shard_rows, dry_run=True)
        new, known, extent = planned.new, planned.known, planned.extent
    elif isinstance(request, Chosen):
        chosen = expand_request(spec, request, [], first_job=0, shard_rows=SHARD_ROWS)
        new, known, extent = chosen.new, chosen.known, chosen.extent
    else:
        new, known, extent = request.samples, 0, request.extent(spec)
    size, cores = _size(spec, new, extent), workers or usable_cores()
    counted = replace(
        DryRun(spec.scene_id, None, new, known, None, True, extent=extent, size_bytes=size, cores=cores),
        workers=workers,
        card_s=estimate_sample_seconds(spec, on_card=True) * new if on_card else None,
    )
    if not (measure and new):
        return counted
    try:
        costs = measure_costs(named.name, min(max(SHARE_S * new, LEAST_S), MOST_S))
    except BackendError as error:
        log(f"cost and time are not known: {error}")
        return counted
    spp, static = 2 * spec.transport.half_spp, not spec.groups
    core_s = costs.seconds(spp, configurations=extent.configurations, views=extent.views, samples=new)
    counted = replace(counted, costs=costs, core_s=core_s, wall_s=core_s / cores)
    if known or isinstance(request, Chosen):
        return counted
    asked = Allocation(request.modifications, request.views_per_modification, request.passes, spp)
    if static:
        asked = replace(asked, modifications=asked.modifications * asked.views, views=1)
    reduction, better = CostModel.of(costs, static=static).improve(asked)
    if reduction < WORTH_A_CHANGE:
        return replace(counted, reduction=reduction)
    modifications, views = (None, None) if static else (better.modifications, better.views)
    suggestion = Suggestion(better.spp // 2, modifications, views, better.samples)
    return replace(counted, reduction=reduction, suggestion=suggestion)
