"""The pilot: a short measurement of error × time that decides between settings of the integrator.

Successive halving (Karnin, Koren and Somekh, ICML 2013): all candidates render a few images, the better half renders
twice as many more, until one is left or the time is up. All candidates use the same seeds, so that their eye paths and
most rare bright samples are the same, and differences between candidates are due to their settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.candidates import (
    PLAIN,
    Candidate,
    ImageCost,
    MeasuredCandidate,
    RelativeErrors,
    Render,
)
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
class PilotResult:
    """What a pilot measured."""

    measured: tuple[MeasuredCandidate, ...]  # in the order of the candidates given; empty if every view is black
    shared: float  # error of the rare bright samples that all candidates share, which `errors` leave out (see `noise`)
    views: int  # the views that were not black


def measure_errors(
    renders: Sequence[Render],
    costs: Mapping[Candidate, ImageCost],
    *,
    later_s: float,
    seconds: float = 60.0,
    spp: int = 4,
    seed: int = 0,
    keep: Sequence[Candidate] = (),
    weigh: Weigh = view_weights,
    clock: Callable[[], float] = backend.work_s,
) -> PilotResult:
    """The errors of candidates whose `costs` are known, over some views; each of `renders` renders one of them.

    Candidates are compared by error × time where an image takes `later_s`. The pilot takes `seconds` of `clock` (CPU
    time) at most, but always completes its first round. It ends earlier when a single candidate is left that does not
    seem to miss light. Plain path tracing, which must be one of them, and those in `keep` are measured to the end for
    comparison. `weigh` says how the noise of pixels counts. Raises ValueError without views, and for images that are
    not finite.
    """
    if not renders:
        raise ValueError("measure_errors: renders is empty; a pilot needs a view at least")
    begun, every, kept = clock(), list(costs), {PLAIN, *keep}
    rounds = _Rounds(renders, costs, later_s, spp, seed, weigh, clock)
    pairs = max(1, -(-LEAST_PAIRS // len(renders)))
    rounds.render(every, pairs)
    if not rounds.weights:
        return PilotResult((), 0.0, 0)
    active = every
    while len(active) > 1:
        ranked = sorted(active, key=rounds.cost)
        best = ranked[: (len(ranked) + 1) // 2]
        if rounds.is_suspect(best[0]):  # missing light shows only with more images: keep a candidate that finds it
            best += [c for c in ranked if not rounds.is_suspect(c)][:1]
        active = [c for c in every if c in best]
        going_on = [c for c in every if c in best or c in kept]
        pairs = rounds.affordable(going_on, 2 * pairs, begun + seconds - clock())
        if not pairs:
            break
        rounds.render(going_on, pairs)
    shared = float(np.mean([np.mean(of_view) for of_view in rounds.shared.values()]))
    return PilotResult(tuple(map(rounds.describe, every)), shared, len(rounds.weights))


class _Rounds:
    """The views, the candidates and the results so far."""

    def __init__(
        self,
        views: Sequence[Render],
        costs: Mapping[Candidate, ImageCost],
        later_s: float,
        spp: int,
        seed: int,
        weigh: Weigh,
        clock: Callable[[], float],
    ) -> None:
        """Compile, and render the images that give each view's weights."""
        self._views, self._costs, self._later_s, self._spp, self._clock = views, costs, later_s, spp, clock
        self._seeds = [count(seed + 1_000_003 * v) for v in range(len(views))]  # far apart, so that no two meet
        self._errors: dict[Candidate, dict[int, list[float]]] = {c: {} for c in costs}  # of an image, by view and pair
        self._seconds: dict[Candidate, list[float]] = {c: [] for c in costs}  # of an image
        self._block_sums = {c: BlockSums() for c in costs}
        self.shared: dict[int, list[float]] = {}  # by view, of each pair: the error that is left out
        self.weights: dict[int, F32] = {}  # by view; black views are left out
        for view, seeds in enumerate(self._seeds):
            every = list(costs) * -(-SCOUTS // len(costs))
            if (weights := weigh([self._image(view, c, next(seeds)) for c in every])) is not None:
                self.weights[view] = weights

    def render(self, candidates: Sequence[Candidate], pairs: int) -> None:
        """Render so many pairs of images of each view, the candidates in turn."""
        for view, weights in self.weights.items():
            for _ in range(pairs):
                seeds = next(self._seeds[view]), next(self._seeds[view])
                firsts, seconds = ([self._image(view, c, seed) for c in candidates] for seed in seeds)
                images = list(zip(firsts, seconds, strict=True))
                errors, shared = pair_errors(images, weights)
                self.shared.setdefault(view, []).append(shared)
                for candidate, error, (a, b) in zip(candidates, errors, images, strict=True):
                    self._errors[candidate].setdefault(view, []).append(error)
                    self._block_sums[candidate].add(a, b, weights, view)

    def _image(self, view: int, candidate: Candidate, seed: int) -> F32:
        start = self._clock()
        image = self._views[view](candidate, seed, self._spp)
        self._seconds[candidate].append(self._clock() - start)
        if not np.isfinite(image).all():
            raise ValueError(f"measure_errors: seed {seed} of candidate {candidate} gave an image that is not finite")
        return image

    def affordable(self, candidates: Sequence[Candidate], pairs: int, seconds: float) -> int:
        """The number of pairs per view, at most `pairs`, that the remaining time allows."""
        per_pair = 2 * len(self.weights) * sum(float(np.median(self._seconds[c])) for c in candidates)
        room = MOST_PAIRS - max(len(self._seen(c)) for c in candidates)
        return max(0, min(pairs, room, int(seconds / max(per_pair, 1e-9))))

    def _seen(self, candidate: Candidate) -> NDArray[np.float64]:
        """The errors that are seen, (pairs, views)."""
        return np.stack(list(self._errors[candidate].values()), axis=1)

    def _inferred(self, candidate: Candidate) -> float:
        """The part of a candidate's error that is inferred from light that others found."""
        others = [sums for c, sums in self._block_sums.items() if c != candidate]
        return charge_for_missed(self._block_sums[candidate], others)

    def is_suspect(self, candidate: Candidate) -> bool:
        """Whether a candidate seems to miss light that others find; the estimate grows with the number of images."""
        inferred = self._inferred(candidate)
        return bool(inferred > SUSPICIOUS * (self._seen(candidate).mean() + inferred))

    def cost(self, candidate: Candidate) -> float:
        """Error × time of a candidate: less is better."""
        error = self._seen(candidate).mean() + self._inferred(candidate)
        return float(error * self._costs[candidate].per_sample_s(self._later_s))

    def describe(self, candidate: Candidate) -> MeasuredCandidate:
        """The errors beside those of plain path tracing, over the images that both rendered with equal seeds."""
        missed, seen = self._inferred(candidate), self._seen(candidate)
        own, plain = seen + missed, self._seen(PLAIN)[: len(seen)] + self._inferred(PLAIN)
        errors = RelativeErrors(images=2 * seen.size, own=_mean_over_pairs(own), plain=_mean_over_pairs(plain))
        return MeasuredCandidate(candidate=candidate, errors=errors, missed=missed, cost=self._costs[candidate])


def _mean_over_pairs(errors: NDArray[np.float64]) -> tuple[float, ...]:
    """The means over pairs, given (pairs, views); for a single view the pairs themselves."""
    return tuple((errors.mean(axis=0) if errors.shape[1] > 1 else errors[:, 0]).tolist())
