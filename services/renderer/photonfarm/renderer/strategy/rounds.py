"""The images of a pilot: how many each candidate has rendered, and their errors and times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.strategy.candidate import PLAIN, Candidate, Render
from photonfarm.renderer.strategy.comparison import MeasuredCandidate, RelativeErrors
from photonfarm.renderer.strategy.noise import BlockSums, missed, pair_errors
from photonfarm.renderer.strategy.objective.purpose import Weigh
from photonfarm.renderer.strategy.reasons import SUSPICIOUS
from photonfarm.shared.core.records import F32

SCOUTS = 8
"""The least images of each view that serve only to weight the others."""

MOST_PAIRS = 32
"""The most pairs of images of one view: more would refine a result that depends on the drawn views anyway."""


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
        self.scouting_s = 0.0
        self.weights: dict[int, F32] = {}  # by view; black views are left out
        self._records: dict[Candidate, dict[int, _Record]] = {c: {} for c in candidates}
        self._block_sums = {c: BlockSums() for c in candidates}
        self._shared: dict[int, list[float]] = {}  # by view, of each pair: the error that is left out

    # ------------------------------------------------------------------------------------------------------ rendering

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
        self.scouting_s = self.spent_s()

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
        left = seconds - self.spent_s()
        per_pair = 2 * len(self.weights) * sum(self._time(c) for c in candidates)
        room = MOST_PAIRS - max(self.images(c) for c in candidates) // (2 * len(self.weights))
        return max(0, min(pairs, room, int(left / max(per_pair, 1e-9))))

    # ------------------------------------------------------------------------------------------------------- figures

    def images(self, candidate: Candidate) -> int:
        """The number of images rendered of a candidate that count."""
        return sum(len(record.times_s) for record in self._records[candidate].values())

    def spent_s(self) -> float:
        """Time since the beginning."""
        return self._clock() - self._begun

    def _time(self, candidate: Candidate) -> float:
        return float(np.mean([np.median(record.times_s) for record in self._records[candidate].values()]))

    def _time_later(self, candidate: Candidate) -> float:
        return self._time(candidate) * self._later.get(candidate, 1.0)

    def missed(self, candidate: Candidate) -> float:
        """The part of a candidate's error that is inferred from light that others found."""
        return missed(self._block_sums[candidate], [sums for c, sums in self._block_sums.items() if c != candidate])

    def _seen(self, candidate: Candidate) -> NDArray[np.float64]:
        """The error that counts, by pairs and views, (pairs, views)."""
        return np.stack([record.errors for record in self._records[candidate].values()], axis=1)

    def shared(self) -> float:
        """The error of rare bright samples that all candidates share in an image, which is left out."""
        return float(np.mean([np.mean(shared) for shared in self._shared.values()]))

    def is_suspect(self, candidate: Candidate) -> bool:
        """Whether a candidate seems to miss light that others find; the estimate grows with the number of images."""
        inferred = self.missed(candidate)
        return bool(inferred > SUSPICIOUS * (self._seen(candidate).mean() + inferred))

    def cost(self, candidate: Candidate) -> float:
        """Error × time of a candidate: less is better."""
        return float((self._seen(candidate).mean() + self.missed(candidate)) * self._time_later(candidate))

    def errors(self, candidate: Candidate) -> RelativeErrors:
        """The errors beside those of plain path tracing, over the images that both rendered with equal seeds."""
        seen = self._seen(candidate)
        own, plain = seen + self.missed(candidate), self._seen(PLAIN)[: len(seen)] + self.missed(PLAIN)
        return RelativeErrors(images=self.images(candidate), own=_by_views(own), plain=_by_views(plain))

    def measured(self, candidate: Candidate) -> MeasuredCandidate:
        """The error × time against plain path tracing."""
        errors = self.errors(candidate)
        cost = errors.ratio * self._time_later(candidate) / self._time_later(PLAIN)
        relative = errors.relative_spread(errors.model_copy(update={"own": errors.plain}))
        return MeasuredCandidate(
            candidate=candidate,
            errors=errors,
            missed=self.missed(candidate),
            time_s=self._time(candidate),
            relative_cost=cost,
            spread=None if relative is None else cost * relative,
        )


def _by_views(errors: NDArray[np.float64]) -> tuple[float, ...]:
    """The means over pairs, given (pairs, views); for a single view the pairs themselves."""
    return tuple((errors.mean(axis=0) if errors.shape[1] > 1 else errors[:, 0]).tolist())
