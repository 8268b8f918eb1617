"""The pilot: a short measurement of variance × time that decides between settings of the integrator.

Successive halving (Karnin, Koren and Somekh, ICML 2013): all candidates render a few images, the better half renders
twice as many more, until one is left or the time is up. All candidates use the same seeds, so that their eye paths and
with them most rare bright samples are the same, and differences between candidates are theirs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.strategy.noise import Tally, missed, not_counted, pair_errors, view_weights
from photonfarm.shared.records import F32

LEAST_PAIRS = 4
"""Pairs of images in the first round, over all views: fewer give no spread."""

SCOUTS = 8
"""Images of each view at least that only serve to weight the others."""

SUSPICIOUS = 0.05
"""Part of a candidate's error that is inferred from light it misses, beyond which that is looked into and told."""

MOST_PAIRS = 32
"""Pairs of images of one view: more would refine what depends on the views drawn anyway."""


@dataclass(frozen=True, slots=True, order=True)
class Candidate:
    """Settings of `bdpt` that leave its mean as it is."""

    connections: int  # light vertices joined to each eye vertex
    light_ratio: float  # light paths per eye path; 0: plain path tracing

    def __str__(self) -> str:
        if not self.light_ratio:
            return "plain path tracing"
        few = {0: "without connections", 1: "with 1 connection"}
        return f"light ratio {self.light_ratio:g} " + few.get(self.connections, f"with {self.connections} connections")


PLAIN = Candidate(0, 0.0)
"""Plain path tracing with next event estimation: what others are measured against."""

Render: TypeAlias = Callable[[Candidate, int, int], F32]
"""(candidate, seed, samples per pixel) → one unbiased noisy image (H, W, 3) of one configuration and view."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What the pilot found of one candidate."""

    candidate: Candidate
    images: int  # over all views
    error: float  # relMSE of one image, mean over the views, with `missed`
    missed: float  # its part that was not seen, but inferred from light that others found (see `noise`)
    time_s: float  # CPU time of one image, mean over the views of their medians
    relative_cost: float  # error × time over that of plain path tracing: the time to the same error
    spread: float | None  # standard error of relative_cost; None of a single pair

    @property
    def efficiency(self) -> float:
        """How many times sooner than plain path tracing it reaches the same error."""
        return 1 / self.relative_cost


@dataclass(frozen=True, slots=True)
class Choice:
    """The candidate to render with, and what that rests on."""

    candidate: Candidate
    measured: tuple[Measured, ...]  # in the order of the candidates given
    reasons: tuple[str, ...]  # sentences
    shared: float  # relMSE of an image that all candidates share in rare bright samples: not in `error` (see `noise`)
    views: int  # that were not black
    spent_s: float  # CPU time of the whole pilot
    scouting_s: float  # the part of it before the first measurement: kernels, and what the images are weighted with

    def row(self, candidate: Candidate) -> Measured:
        """What was measured of a candidate."""
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
    clock: Callable[[], float] = time.process_time,
) -> Choice:
    """The candidate of least error × time over some views, each given by a function that renders it.

    `seconds` of `clock` (CPU time) bound the pilot; its first round is run whatever it takes. It ends before that once
    one candidate is left which seems to miss nothing. `keep` names candidates
    that are measured to the end for comparison, as plain path tracing always is, being added if it is missing. Images
    are compared at `spp`, and their time includes what an image costs whatever its samples are, so `spp` should be that
    of later use; or `later` says for each candidate how many times longer its images take in later use. Raises
    ValueError for no views, or for images that are not finite.
    """
    views = [renders] if callable(renders) else list(renders)
    if not views:
        raise ValueError("choose: renders is empty; a pilot needs a view at least")
    every = list(dict.fromkeys([PLAIN, *candidates]))
    kept = {PLAIN, *keep}
    pilot = _Pilot(views, every, spp, seed, later or {}, clock)
    active = every
    pairs = max(1, -(-LEAST_PAIRS // len(views)))
    pilot.scout()
    pilot.round(every, pairs)
    while pilot.weights and len(active) > 1:
        ranked = sorted(active, key=pilot.cost)
        best = ranked[: (len(ranked) + 1) // 2]
        if pilot.is_suspect(best[0]):  # what it misses only shows with more images: keep one that finds it
            best += [c for c in ranked if not pilot.is_suspect(c)][:1]
        active = [c for c in every if c in best]
        pairs = pilot.affordable([*active, *(kept - set(active))], 2 * pairs, seconds)
        if not pairs:
            break
        pilot.round([c for c in every if c in best or c in kept], pairs)
    return pilot.choice(_most_measured(pilot, every))


def _most_measured(pilot: _Pilot, every: Sequence[Candidate]) -> list[Candidate]:
    most = max(pilot.images(c) for c in every)
    return [c for c in every if pilot.images(c) == most]


@dataclass(slots=True)
class _Record:
    """One candidate's measurements in one view."""

    errors: list[float] = field(default_factory=list)  # relMSE of an image, by each pair
    times_s: list[float] = field(default_factory=list)


class _Pilot:
    """The views, the candidates and what is known so far."""

    def __init__(
        self,
        views: Sequence[Render],
        candidates: Sequence[Candidate],
        spp: int,
        seed: int,
        later: Mapping[Candidate, float],
        clock: Callable[[], float],
    ) -> None:
        self._views = views
        self._candidates = candidates
        self._spp = spp
        self._seeds = [count(seed + 1_000_003 * v) for v in range(len(views))]
        self._later = later
        self._clock = clock
        self._begun = clock()
        self._scouting_s = 0.0
        self.weights: dict[int, F32] = {}  # by view; black views are left out
        self._records: dict[Candidate, dict[int, _Record]] = {c: {} for c in candidates}
        self._tallies = {c: Tally() for c in candidates}
        self._shared: dict[int, list[float]] = {}  # by view, of each pair

    # ------------------------------------------------------------------------------------------------------ rendering

    def scout(self) -> None:
        """Compile, and render what the images of each view will be weighted with."""
        turns = -(-SCOUTS // len(self._candidates))
        for view, render in enumerate(self._views):
            every = list(self._candidates) * turns
            weights = view_weights([self._render(render, c, next(self._seeds[view])) for c in every])
            if weights is not None:
                self.weights[view] = weights
                for candidate in self._candidates:
                    self._records[candidate][view] = _Record()
        self._scouting_s = self._clock() - self._begun

    def round(self, candidates: Sequence[Candidate], pairs: int) -> None:
        """Render images, the candidates in turn: what slows the machine down slows down all of them."""
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
            self._tallies[candidate].add(a, b, self.weights[view], view)

    def _render(self, render: Render, candidate: Candidate, seed: int) -> F32:
        image = render(candidate, seed, self._spp)
        if not np.isfinite(image).all():
            raise ValueError(f"choose: seed {seed} of candidate {candidate} gave an image that is not finite")
        return image

    def affordable(self, candidates: Sequence[Candidate], pairs: int, seconds: float) -> int:
        """How many pairs per view, of those wanted, the time that is left allows."""
        left = seconds - (self._clock() - self._begun)
        per_pair = 2 * len(self.weights) * sum(self._time(c) for c in candidates)
        room = MOST_PAIRS - max(self.images(c) for c in candidates) // (2 * len(self.weights))
        return max(0, min(pairs, room, int(left / max(per_pair, 1e-9))))

    # ------------------------------------------------------------------------------------------------------- figures

    def images(self, candidate: Candidate) -> int:
        """Images rendered of a candidate that count."""
        return sum(len(record.times_s) for record in self._records[candidate].values())

    def _time(self, candidate: Candidate) -> float:
        return float(np.mean([np.median(record.times_s) for record in self._records[candidate].values()]))

    def _time_later(self, candidate: Candidate) -> float:
        return self._time(candidate) * self._later.get(candidate, 1.0)

    def _missed(self, candidate: Candidate) -> float:
        return missed(self._tallies[candidate], [tally for c, tally in self._tallies.items() if c != candidate])

    def _seen(self, candidate: Candidate) -> NDArray[np.float64]:
        """relMSE that counts, by pairs and views, (pairs, views)."""
        columns = []
        for view, record in self._records[candidate].items():
            columns.append(np.array(record.errors) - not_counted(self._shared[view])[: len(record.errors)])
        return np.stack(columns, axis=1)

    def _not_counted(self) -> float:
        return float(np.mean([not_counted(shared).mean() for shared in self._shared.values()]))

    def is_suspect(self, candidate: Candidate) -> bool:
        """Whether it seems to miss light that others find; how much of it grows with the images it is judged by."""
        inferred = self._missed(candidate)
        return bool(inferred > SUSPICIOUS * (self._seen(candidate).mean() + inferred))

    def cost(self, candidate: Candidate) -> float:
        """Error × time of a candidate: less is better."""
        return float((self._seen(candidate).mean() + self._missed(candidate)) * self._time_later(candidate))

    def _measured(self, candidate: Candidate) -> Measured:
        """Error × time against plain path tracing, over the images that both rendered with equal seeds.

        The spread is that of a ratio of means (Cochran, *Sampling Techniques*, 6.5), over views, each the mean of its
        pairs of images: so it holds what the noise and what the choice of views contribute; that of the times is next
        to nothing. Of a single view it is that over pairs.
        """
        own, plain = self._seen(candidate), self._seen(PLAIN)[: len(self._seen(candidate))]
        inferred, inferred_plain = self._missed(candidate), self._missed(PLAIN)
        error = max(float(own.mean()) + inferred, 1e-30)
        error_plain = max(float(plain.mean()) + inferred_plain, 1e-30)
        ratio = error / error_plain * self._time_later(candidate) / self._time_later(PLAIN)
        residual = (own + inferred) / error - (plain + inferred_plain) / error_plain
        residual = residual.mean(axis=0) if residual.shape[1] > 1 else residual[:, 0]
        relative = np.sqrt(np.sum(residual**2) / (len(residual) * (len(residual) - 1))) if len(residual) > 1 else None
        return Measured(
            candidate=candidate,
            images=self.images(candidate),
            error=error,
            missed=inferred,
            time_s=self._time(candidate),
            relative_cost=float(ratio),
            spread=None if relative is None else float(ratio * relative),
        )

    def choice(self, finalists: Sequence[Candidate]) -> Choice:
        """The best of the candidates that were measured longest."""
        spent = self._clock() - self._begun
        if not self.weights:
            sentence = "every view of the pilot is black: there is no light to model, so plain path tracing does"
            return Choice(PLAIN, (), (sentence,), 0.0, 0, spent, self._scouting_s)
        best = min(finalists, key=self.cost)
        rows = tuple(self._measured(c) for c in self._candidates)
        shared = self._not_counted()
        return Choice(best, rows, _reasons(best, rows, shared), shared, len(self.weights), spent, self._scouting_s)


def _reasons(best: Candidate, rows: Sequence[Measured], shared: float) -> tuple[str, ...]:
    chosen = next(row for row in rows if row.candidate == best)
    reasons = []
    if best == PLAIN:
        why = "nothing else reaches its error sooner" if rows[1:] else "there is nothing else to compare it with"
        reasons.append(f"{best} is best: {why}")
    else:
        share = plus_minus(chosen.relative_cost, chosen.spread)
        reasons.append(f"{best} is best: it reaches the error of {PLAIN} in {share} of the time")
    if alike := [str(row.candidate) for row in rows if row is not chosen and _is_alike(row, chosen)]:
        reasons.append(f"not to be told from it, within two standard errors: {', '.join(alike)}")
    reasons += [
        f"{row.candidate} misses light that others find: {row.missed / row.error:.0%} of its error is inferred from "
        "that, and the true one may be larger"
        for row in rows
        if row.missed > (SUSPICIOUS if row is chosen else 0.5) * row.error
    ]
    if shared > 0.5 * chosen.error:
        reasons.append(
            "rare bright samples that all settings compared have in common are left out of the comparison: they add "
            f"about {shared:.2g} to the relMSE of an image, which is {chosen.error:.2g} without them"
        )
    return tuple(reasons)


def _is_alike(row: Measured, chosen: Measured) -> bool:
    """Whether the costs of two candidates differ by less than twice the standard error of their difference.

    Those of both are taken as independent, which overstates it.
    """
    if row.spread is None or chosen.spread is None:
        return False
    return row.relative_cost - chosen.relative_cost < 2 * math.hypot(row.spread, chosen.spread)


def plus_minus(value: float, spread: float | None) -> str:
    """A value and its standard error, "0.34 ± 0.02", as `rounded`."""
    return " ± ".join(filter(None, rounded(value, spread)))


def rounded(value: float, spread: float | None) -> tuple[str, str]:
    """A value and its standard error to the same decimal place; the second is empty where there is no error.

    It is that of the error's first digit, but tenths for errors of 1 to 10 and ones above.
    """
    if not spread:
        return f"{value:.3g}", ""
    places = min(max(-math.floor(math.log10(spread)), int(spread < 10)), 6)
    return f"{value:.{places}f}", f"{spread:.{places}f}"
