"""A validation during training, and its comparison with the run's best one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.data.batch import TrainingBatch, take_one
from photonfarm.trainer.predictors.evaluation import HeldOutErrors, Predictor, measure

Show = Callable[[int, tuple[int, ...], F32, F32], None]
"""A callback with the step, rows of the store, and their targets and predictions."""

SHOWN = 4
"""The least samples of a validation that are shown, if it has so many."""

WORSE = 0.1
"""The share of the best error by which a validation may be worse: less is noise of a learning rate still high."""

DEVIATIONS = 2.0
"""The standard errors of the paired difference by which it must be worse to be clearly so.

Few configurations are held out while a store is young.
"""

HELD_OUT, EXCESS = "held-out error", "held-out loss above that of clean images"
ALL_LIGHT = "all light"
UP_TO_WHITE = "means of blocks, up to white"


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """The held-out error of a network at a step."""

    step: int
    rows: tuple[int, ...]  # (n,) the measured rows, in the order of `held_out.per_sample`
    held_out: HeldOutErrors
    judge: str = ALL_LIGHT  # which error is compared
    excesses: Mapping[int, float] = field(default_factory=dict)  # of each row's loss over that of its clean image; none
    # where the loss has no known floor

    @property
    def errors(self) -> dict[int, float]:
        """The error of each row, by which validations are compared."""
        errors = self.held_out.shown if self.judge == UP_TO_WHITE else self.held_out.per_sample
        return dict(zip(self.rows, errors.tolist(), strict=True))

    @property
    def excess(self) -> Estimate | None:
        """The mean of the excesses over configurations."""
        excesses = np.array([*self.excesses.values()])
        return Estimate.of(group_means(excesses, self.held_out.units)) if self.excesses else None

    @property
    def is_finite(self) -> bool:
        """Whether the error is finite."""
        return math.isfinite(self.held_out.error.mean)

    def state(self) -> dict[str, Any]:
        """What a later validation is compared with, for a checkpoint."""
        rows, errors = list(self.errors), list(self.errors.values())
        return {
            "step": self.step,
            "judge": self.judge,
            "rows": torch.tensor(rows, dtype=torch.int64),
            "errors": torch.tensor(errors, dtype=torch.float64),
            "excesses": torch.tensor([*self.excesses.values()], dtype=torch.float64),
        }


def validate(
    predict: Predictor,
    step: int,
    samples: Iterator[TrainingBatch],
    show: Show | None = None,
    *,
    loss: str = "linear",
    measure_excess: Callable[[Tensor, TrainingBatch], Tensor | None] | None = None,
) -> Validation:
    """Measure a network over held-out samples; `show` gets targets and predictions of the first `SHOWN` or more.

    `measure_excess` is a learner's.

    The linear loss weights all light alike. A network with another loss is compared by the error of light up to white:
    that loss gives less weight to lamps in view, which make up most of the error of all light.

    Raises IncompleteError if there is no sample.
    """
    rows: list[int] = []
    shown: list[tuple[tuple[int, ...], F32, F32]] = []
    excesses: list[float] = []

    def noted() -> Iterator[TrainingBatch]:
        for batch in samples:
            rows.extend(batch.rows)
            yield batch

    def predict_and_keep(batch: TrainingBatch) -> F32:
        images = predict(batch)
        if measure_excess is not None:
            on_device = torch.from_numpy(images).to(batch.target.device)
            for place in range(len(batch.rows)):
                excess = measure_excess(on_device[place : place + 1], take_one(batch, place))
                excesses.extend([] if excess is None else [float(excess)])
        if show is not None and len(shown) * len(batch.rows) < SHOWN:
            shown.append((batch.rows, batch.target.mean(dim=1).cpu().numpy(), images.copy()))
        return images

    with np.errstate(invalid="ignore", over="ignore"):  # overflows of a diverged network, which is reported as such
        held_out = measure(predict_and_keep, noted())
    if show is not None:
        targets, predictions = (np.concatenate(each) for each in list(zip(*shown, strict=True))[1:])
        show(step, tuple(row for each, *_ in shown for row in each), targets, predictions)
    judge = ALL_LIGHT if loss == "linear" else UP_TO_WHITE
    return Validation(step, tuple(rows), held_out, judge, dict(zip(rows, excesses, strict=True)) if excesses else {})


@dataclass(frozen=True, slots=True)
class Comparison:
    """A validation compared with the best one before, over the rows that both have measured."""

    error: float  # of this validation
    best: float  # of the best
    difference: Estimate  # this minus the best, over configurations
    is_best: bool  # this validation is the best from now on
    what: str = HELD_OUT  # is compared

    @property
    def is_worse(self) -> bool:
        """Whether it is worse by more than `WORSE`, or not finite."""
        return not self.error - self.best <= WORSE * abs(self.best)

    @property
    def is_beyond_chance(self) -> bool:
        """Whether it is worse by more than chance, however little; for a single configuration, chance is not known."""
        deviation = self.difference.standard_error
        return deviation is not None and self.difference.mean > DEVIATIONS * deviation

    @property
    def is_clearly_worse(self) -> bool:
        """Whether it is worse by more than `WORSE` and by more than chance, or not finite."""
        return not math.isfinite(self.error) or (self.is_worse and self.is_beyond_chance)

    @property
    def sentence(self) -> str:
        """Both errors in words."""
        before = f", and was {self.best:.5g} at best" if math.isfinite(self.best) else ""
        return f"the {self.what} is {self.error:.5g}{before}"


def compare(
    now: Validation, best: Mapping[str, Any] | None, of: Literal["errors", "excesses"] = "errors"
) -> Comparison:
    """Compare a validation with the `state` of the best one; with itself if there is none of the same rows and error.

    The held-out set grows while the store does, and samples may be incomplete for a while: the mean over other rows
    would be another figure, whatever the network. Views of one configuration are averaged first, as in `measure`.
    """
    mine = theirs = now.errors if of == "errors" else now.excesses
    if best is not None and best["judge"] == now.judge:
        before_of = dict(zip(best["rows"].tolist(), best[of].tolist(), strict=True))
        theirs = mine if before_of.keys().isdisjoint(mine) else before_of
    units = [unit for row, unit in zip(now.rows, now.held_out.units, strict=True) if row in theirs]
    rows = [row for row in now.rows if row in theirs]
    ours, others = (group_means(np.array([errors[row] for row in rows]), units) for errors in (mine, theirs))
    error, before, what = float(ours.mean()), float(others.mean()), HELD_OUT if of == "errors" else EXCESS
    if not now.is_finite:
        return Comparison(math.nan, before, Estimate(math.nan, None, len(ours)), is_best=False, what=what)
    return Comparison(error, before, Estimate.of(ours - others), theirs is mine or error < before, what)


@dataclass(frozen=True, slots=True)
class Standing:
    """A validation beside the best ones of its run."""

    error: Comparison  # by its judge, with the best
    excess: Comparison | None  # with the least
    is_good: bool  # its weights are worth keeping: not worse than the best, and of the least excess but for chance
    learns_by_heart: bool  # more steps on the samples that there are make it worse on others

    @property
    def rise(self) -> Comparison | None:
        """The comparison by which the run had better end with the weights that it has kept, if there is one."""
        has_risen = self.excess is not None and self.excess.is_clearly_worse
        return self.excess if has_risen else self.error if self.error.is_worse else None


class BestValidations:
    """The validations of a run that others are held against: the best one by its judge, and that of the least excess.

    They may differ: the judge sees what a display shows, and the excess is in the units and weights of the loss.
    """

    def __init__(self) -> None:
        """There is none yet."""
        self._best: Mapping[str, Any] | None = None
        self._least: Mapping[str, Any] | None = None

    def place(self, now: Validation, training: float | None) -> Standing:
        """Hold a validation against them, and let it be the best, or the least, from now on if it is.

        With `training`, the excess on training samples, these are learned by heart if it has halved since the held-out
        excess was least, and that is clearly higher now; where a run diverges, both rise. Once `training` is below 0,
        no weights are good but those of the least.
        """
        error = compare(now, self._best)
        self._best = now.state() if error.is_best else self._best
        if now.excess is None or not now.is_finite:
            return Standing(error, None, is_good=not error.is_worse, learns_by_heart=False)
        before = None if self._least is None else self._least["training"]
        excess = compare(now, self._least, "excesses")
        self._least = {**now.state(), "training": training} if excess.is_best else self._least
        has_halved = training is not None and before is not None and training < before / 2
        is_least = excess.is_best or not ((training or 0) < 0 or excess.is_beyond_chance)
        return Standing(
            error,
            excess,
            is_good=is_least and not error.is_worse,
            learns_by_heart=has_halved and excess.is_clearly_worse,
        )

    def state(self) -> dict[str, Any]:
        """Their part of a checkpoint."""
        return {"best": self._best, "least": self._least}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`; that of before there was a least one has none."""
        self._best, self._least = state["best"], state.get("least")
