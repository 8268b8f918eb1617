"""The pilot: a short measurement of variance × time that decides between settings of the integrator.

Successive halving (Karnin, Koren and Somekh, ICML 2013): all candidates render a few images, the better half renders
twice as many more, until one is left or the time is up. All candidates use the same seeds, so that their eye paths and
most rare bright samples are the same, and differences between candidates are due to their settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidate import PLAIN, Candidate, Render
from photonfarm.renderer.strategy.comparison import MeasuredCandidate
from photonfarm.renderer.strategy.noise import view_weights
from photonfarm.renderer.strategy.objective.purpose import Weigh
from photonfarm.renderer.strategy.reasons import BLACK, reasons_for
from photonfarm.renderer.strategy.rounds import Rounds

LEAST_PAIRS = 4
"""The least number of pairs of images in the first round, over all views: fewer would give no standard error."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen candidate, and its evidence."""

    candidate: Candidate
    measured: tuple[MeasuredCandidate, ...]  # in the order of the candidates given
    reasons: tuple[str, ...]  # sentences
    shared: float  # error of the rare bright samples that all candidates share, which `error` leaves out (see `noise`)
    views: int  # the views that were not black
    spent_s: float  # CPU time of the whole pilot
    scouting_s: float  # the part before the first measurement: kernels, and the images that give the weights

    def row(self, candidate: Candidate) -> MeasuredCandidate:
        """The measurement of a candidate."""
        return next(row for row in self.measured if row.candidate == candidate)


def choose(
    renders: Render | Sequence[Render],
    candidates: Sequence[Candidate],
    *,
    seconds: float = 60.0,
    spp: int = 4,
    seed: int = 0,
    keep: Sequence[Candidate] = (),
    later: Mapping[Candidate, float] | None = None,
    weigh: Weigh = view_weights,
    clock: Callable[[], float] = backend.work_s,
) -> Choice:
    """The candidate with the least error × time over some views; each of `renders` renders one view.

    The pilot takes `seconds` of `clock` (CPU time) at most, but always completes its first round. It ends earlier when
    a single candidate is left that does not seem to miss light. Candidates in `keep` are measured to the end for
    comparison, and so is plain path tracing, which is added if it is missing.

    Images are compared at `spp` samples per pixel, and their time includes the fixed part of an image. So `spp` should
    be that of later use. Otherwise `later` gives a factor for each candidate: the time that later use takes to the
    error of one image of the pilot, over the time of that image. `weigh` says how the noise of pixels counts. Raises
    ValueError without views, or for images that are not finite.
    """
    views = [renders] if callable(renders) else list(renders)
    if not views:
        raise ValueError("choose: renders is empty; a pilot needs a view at least")
    every = list(dict.fromkeys([PLAIN, *candidates]))
    rounds = Rounds(views, every, spp, seed, later or {}, weigh, clock)
    rounds.scout()
    pairs = max(1, -(-LEAST_PAIRS // len(views)))
    rounds.round(every, pairs)
    if rounds.weights:
        _halve(rounds, every, pairs, {PLAIN, *keep}, seconds)
    return _choice(rounds, every)


def _halve(rounds: Rounds, every: Sequence[Candidate], pairs: int, kept: set[Candidate], seconds: float) -> None:
    """Drop the worse half and measure the others twice as long, repeatedly; each has `pairs` of each view before."""
    active = list(every)
    while len(active) > 1:
        ranked = sorted(active, key=rounds.cost)
        best = ranked[: (len(ranked) + 1) // 2]
        if rounds.is_suspect(best[0]):  # missing light shows only with more images: keep a candidate that finds it
            best += [c for c in ranked if not rounds.is_suspect(c)][:1]
        active = [c for c in every if c in best]
        pairs = rounds.affordable([*active, *(kept - set(active))], 2 * pairs, seconds)
        if not pairs:
            break
        rounds.round([c for c in every if c in best or c in kept], pairs)


def _choice(rounds: Rounds, every: Sequence[Candidate]) -> Choice:
    """The choice of the best candidate among those that were measured longest."""
    spent, scouting = rounds.spent_s(), rounds.scouting_s
    if not rounds.weights:
        return Choice(PLAIN, (), (BLACK,), 0.0, 0, spent, scouting)
    best = min(longest(every, rounds.images), key=rounds.cost)
    rows = tuple(map(rounds.measured, every))
    shared = rounds.shared()
    chosen = next(row for row in rows if row.candidate == best)
    return Choice(best, rows, reasons_for(chosen, rows, shared), shared, len(rounds.weights), spent, scouting)


def longest(candidates: Sequence[Candidate], images: Callable[[Candidate], int]) -> list[Candidate]:
    """The candidates with the most images, as one with few images may be the best by chance."""
    most = max(map(images, candidates))
    return [c for c in candidates if images(c) == most]
