"""The pilot: a short measurement of variance × time that decides between settings of the integrator.

Successive halving (Karnin, Koren and Somekh, ICML 2013): all candidates render a few images, the better half renders
twice as many more, until one is left or the time is up. All candidates use the same seeds, so that their eye paths and
most rare bright samples are the same, and differences between candidates are due to their settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate, MeasuredCandidate, RelativeErrors, Render
from photonfarm.renderer.strategy.noise import BlockSums, Weigh, charge_for_missed, pair_errors, view_weights

LEAST_PAIRS = 4
"""The least number of pairs of images in the first round, over all views: fewer would give no standard error."""

SCOUTS = 8
"""The least images of each view that serve only to weight the others."""

MOST_PAIRS = 32
"""The most pairs of images of one view: more would refine a result that depends on the drawn views anyway."""

SUSPICIOUS = 0.05
"""The share of missed light in a candidate's error above which it is examined and reported."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen candidate, and its evidence."""

    candidate: Candidate
    measured: tuple[MeasuredCandidate, ...]  # in the order of the candidates given; empty if every view is black
    shared: float  # error of the rare bright samples that all candidates share, which `error` leaves out (see `noise`)
    views: int  # the views that were not black

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
    if not rounds.weights:
        return Choice(PLAIN, (), 0.0, 0)
    _halve(rounds, every, pairs, {PLAIN, *keep}, seconds)
    best = min(longest(every, rounds.images), key=rounds.cost)
    return Choice(best, tuple(map(rounds.describe, every)), rounds.shared_error(), len(rounds.weights))


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


def longest(candidates: Sequence[Candidate], images: Callable[[Candidate], int]) -> list[Candidate]:
    """The candidates with the most images, as one with few images may be the best by chance."""
    most = max(map(images, candidates))
    return [c for c in candidates if images(c) == most]


@dataclass(slots=True)
class _Record:
    """One candidate's measurements in one view."""

    errors: list[float] = field(default_factory=list)  # of an image, by each pair
    times_s: list[float] = field(default_factory=list)


class Rounds:
    """The views, the candidates and the results so far."""

    def __init__(
        self,
        views: Sequence[Render],
        candidates: Sequence[Candidate],
        spp: int,
        seed: int,
        later: Mapping[Candidate, float],
        weigh: Weigh,
        clock: Callable[[], float],
    ) -> None:
        self._views = views
        self._candidates = candidates
        self._spp = spp
        self._seeds = [count(seed + 1_000_003 * v) for v in range(len(views))]
        self._later = later
        self._weigh = weigh
        self._clock = clock
        self._begun = clock()
        self.weights: dict[int, F32] = {}  # by view; black views are left out
        self._records: dict[Candidate, dict[int, _Record]] = {c: {} for c in candidates}
        self._block_sums = {c: BlockSums() for c in candidates}
        self._shared: dict[int, list[float]] = {}  # by view, of each pair: the error that is left out

    def scout(self) -> None:
        """Compile, and render the images that give each view's weights."""
        turns = -(-SCOUTS // len(self._candidates))
        for view, render in enumerate(self._views):
            every = list(self._candidates) * turns
            weights = self._weigh([self._render(render, c, next(self._seeds[view])) for c in every])
            if weights is not None:
                self.weights[view] = weights
                for candidate in self._candidates:
                    self._records[candidate][view] = _Record()

    def round(self, candidates: Sequence[Candidate], pairs: int) -> None:
        """Render images, the candidates in turn, so that a slower machine slows all of them down."""
        for view in self.weights:
            for _ in range(pairs):
                seeds = next(self._seeds[view]), next(self._seeds[view])
                images: dict[Candidate, list[F32]] = {c: [] for c in candidates}
                for seed in seeds:
                    for candidate in candidates:
                        start = self._clock()
                        images[candidate].append(self._render(self._views[view], candidate, seed))
                        self._records[candidate][view].times_s.append(self._clock() - start)
                self._note(view, {candidate: (a, b) for candidate, (a, b) in images.items()})

    def _note(self, view: int, pairs: dict[Candidate, tuple[F32, F32]]) -> None:
        errors, shared = pair_errors(list(pairs.values()), self.weights[view])
        self._shared.setdefault(view, []).append(shared)
        for (candidate, (a, b)), error in zip(pairs.items(), errors, strict=True):
            self._records[candidate][view].errors.append(error)
            self._block_sums[candidate].add(a, b, self.weights[view], view)

    def _render(self, render: Render, candidate: Candidate, seed: int) -> F32:
        image = render(candidate, seed, self._spp)
        if not np.isfinite(image).all():
            raise ValueError(f"choose: seed {seed} of candidate {candidate} gave an image that is not finite")
        return image

    def affordable(self, candidates: Sequence[Candidate], pairs: int, seconds: float) -> int:
        """The number of pairs per view, at most `pairs`, that the remaining time allows."""
        left = seconds - (self._clock() - self._begun)
        per_pair = 2 * len(self.weights) * sum(self._time(c) for c in candidates)
        room = MOST_PAIRS - max(self.images(c) for c in candidates) // (2 * len(self.weights))
        return max(0, min(pairs, room, int(left / max(per_pair, 1e-9))))

    def images(self, candidate: Candidate) -> int:
        """The number of images rendered of a candidate that count."""
        return sum(len(record.times_s) for record in self._records[candidate].values())

    def _time(self, candidate: Candidate) -> float:
        return float(np.mean([np.median(record.times_s) for record in self._records[candidate].values()]))

    def _time_later(self, candidate: Candidate) -> float:
        return self._time(candidate) * self._later.get(candidate, 1.0)

    def inferred_error(self, candidate: Candidate) -> float:
        """The part of a candidate's error that is inferred from light that others found."""
        return charge_for_missed(
            self._block_sums[candidate], [sums for c, sums in self._block_sums.items() if c != candidate]
        )

    def _errors_that_count(self, candidate: Candidate) -> NDArray[np.float64]:
        """The error that counts, by pairs and views, (pairs, views)."""
        return np.stack([record.errors for record in self._records[candidate].values()], axis=1)

    def shared_error(self) -> float:
        """The error of rare bright samples that all candidates share in an image, which is left out."""
        return float(np.mean([np.mean(shared) for shared in self._shared.values()]))

    def is_suspect(self, candidate: Candidate) -> bool:
        """Whether a candidate seems to miss light that others find; the estimate grows with the number of images."""
        inferred = self.inferred_error(candidate)
        return bool(inferred > SUSPICIOUS * (self._errors_that_count(candidate).mean() + inferred))

    def cost(self, candidate: Candidate) -> float:
        """Error × time of a candidate: less is better."""
        return float(
            (self._errors_that_count(candidate).mean() + self.inferred_error(candidate)) * self._time_later(candidate)
        )

    def errors(self, candidate: Candidate) -> RelativeErrors:
        """The errors beside those of plain path tracing, over the images that both rendered with equal seeds."""
        seen = self._errors_that_count(candidate)
        own, plain = (
            seen + self.inferred_error(candidate),
            self._errors_that_count(PLAIN)[: len(seen)] + self.inferred_error(PLAIN),
        )
        return RelativeErrors(images=self.images(candidate), own=_mean_over_pairs(own), plain=_mean_over_pairs(plain))

    def describe(self, candidate: Candidate) -> MeasuredCandidate:
        """The error × time against plain path tracing."""
        errors = self.errors(candidate)
        cost = errors.ratio * self._time_later(candidate) / self._time_later(PLAIN)
        relative = errors.relative_spread(errors.model_copy(update={"own": errors.plain}))
        return MeasuredCandidate(
            candidate=candidate,
            errors=errors,
            missed=self.inferred_error(candidate),
            time_s=self._time(candidate),
            relative_cost=cost,
            spread=None if relative is None else cost * relative,
        )


def _mean_over_pairs(errors: NDArray[np.float64]) -> tuple[float, ...]:
    """The means over pairs, given (pairs, views); for a single view the pairs themselves."""
    return tuple((errors.mean(axis=0) if errors.shape[1] > 1 else errors[:, 0]).tolist())
