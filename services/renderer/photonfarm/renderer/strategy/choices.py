"""Candidates compared at equal cost: their errors in the CPU time that a spec allows for a half-estimate."""

from __future__ import annotations

from dataclasses import dataclass

from photonfarm.renderer.strategy.candidate import PLAIN, Candidate
from photonfarm.renderer.strategy.comparison import MeasuredCandidate, saving
from photonfarm.renderer.strategy.measurement import CandidateRow, Measurement
from photonfarm.renderer.strategy.pilot import longest


@dataclass(frozen=True, slots=True)
class CandidateAtCost(MeasuredCandidate):
    """A candidate with the samples per pixel that fit the time; `time_s` is the time of such a half-estimate."""

    half_spp: int
    half_error: float  # of such a half-estimate: relMSE, or relative loss (see `noise`)
    fits: bool  # whether at least about one sample per pixel fits the time


def candidates_at_equal_cost(measurement: Measurement, half_s: float) -> dict[Candidate, CandidateAtCost]:
    """Every measured candidate, at the samples per pixel that fit `half_s`.

    The variance of an image is that of one sample over the number of samples n. So error × time is the error of one
    sample × time / n. For training, time contains the half's part of what its sample takes beside. That is the same for
    all candidates, and so matters only as far as whole numbers of samples do not take exactly `half_s`.
    """
    return {row.candidate: _at_cost(row, measurement, half_s) for row in measurement.rows}


def _at_cost(row: CandidateRow, measurement: Measurement, half_s: float) -> CandidateAtCost:
    plain, beside_s = measurement.row(PLAIN), measurement.view_cost.half_s
    samples = row.cost.bought(half_s)
    cost = row.errors.ratio * _per_sample_s(row, half_s, beside_s) / _per_sample_s(plain, half_s, beside_s)
    relative = row.errors.relative_spread(plain.errors)
    return CandidateAtCost(
        candidate=row.candidate,
        errors=row.errors,
        missed=row.missed,
        time_s=row.cost.time_s(samples),
        relative_cost=cost,
        spread=None if relative is None else cost * relative,
        half_spp=samples,
        half_error=row.errors.mean * measurement.spp / samples,
        fits=row.cost.pays(half_s),
    )


def _per_sample_s(row: CandidateRow, half_s: float, beside_s: float) -> float:
    samples = row.cost.bought(half_s)
    return (row.cost.time_s(samples) + beside_s) / samples


def best(candidates: dict[Candidate, CandidateAtCost]) -> CandidateAtCost:
    """The candidate with the least error × time, among those that were measured longest."""
    return min((candidates[c] for c in longest(list(candidates), lambda c: candidates[c].errors.images)), key=_cost)


def _cost(at_cost: CandidateAtCost) -> float:
    return at_cost.relative_cost


def settled(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int]:
    """The settings to choose, given present ones: these, or others that are significantly better at the same cost.

    Rounding to a whole number of samples changes the cost a little, and at the new cost another candidate may be better
    still. So the search goes on until nothing is better, and a plan made for the result chooses it again. If the search
    comes back to earlier settings, the present ones stay.
    """
    seen = [(candidate, half_spp)]
    while (better := _better(measurement, *seen[-1])) is not None:
        if better in seen:
            return seen[0]
        seen.append(better)
    return seen[-1]


def _better(measurement: Measurement, candidate: Candidate, half_spp: int) -> tuple[Candidate, int] | None:
    candidates = candidates_at_equal_cost(measurement, measurement.row(candidate).cost.time_s(half_spp))
    fitting = {c: at_cost for c, at_cost in candidates.items() if at_cost.fits}
    found = best(fitting)
    if found.candidate == candidate or not saving(found, over=candidates[candidate]).significant:
        return None
    return found.candidate, found.half_spp
