"""A validation during training, and its comparison with the run's best one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.data.batch import TrainingBatch
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

ALL_LIGHT = "all light"
UP_TO_WHITE = "means of blocks, up to white"


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """The held-out error of a network at a step."""

    step: int
    rows: tuple[int, ...]  # (n,) the measured rows, in the order of `held_out.per_sample`
    held_out: HeldOutErrors
    judge: str = ALL_LIGHT  # which error is compared
    excess: Estimate | None = None  # of the loss over that of the clean images, over batches

    @property
    def errors(self) -> dict[int, float]:
        """The error of each row, by which validations are compared."""
        errors = self.held_out.shown if self.judge == UP_TO_WHITE else self.held_out.per_sample
        return dict(zip(self.rows, errors.tolist(), strict=True))

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
        }


def validate(
    predict: Predictor,
    step: int,
    samples: Iterator[TrainingBatch],
    show: Show | None = None,
    *,
    loss: str = "linear",
    measure_excess: Callable[[Tensor, TrainingBatch], Tensor | None] = lambda *_: None,
) -> Validation:
    """Measure a network over held-out samples; `show` gets targets and predictions of the first `SHOWN` or more.

    `measure_excess` is a learner's.

    The linear loss weights all light alike. A network with another loss is compared by the error of light up to white:
    that loss gives less weight to lamps in view, which make up most of the error of all light.

    Raises IncompleteError if there is no sample.
    """
    rows: list[int] = []
    shown: list[tuple[tuple[int, ...], F32, F32]] = []
    excesses: list[float] = []  # of each batch

    def noted() -> Iterator[TrainingBatch]:
        for batch in samples:
            rows.extend(batch.rows)
            yield batch

    def predict_and_keep(batch: TrainingBatch) -> F32:
        images = predict(batch)
        excess = measure_excess(torch.from_numpy(images).to(batch.target.device), batch)
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
    return Validation(step, tuple(rows), held_out, judge, Estimate.of(np.array(excesses)) if excesses else None)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A validation compared with the best one before, over the rows that both have measured."""

    error: float  # of this validation
    best: float  # of the best
    difference: Estimate  # this minus the best, over configurations
    is_best: bool  # this validation is the best from now on

    @property
    def is_worse(self) -> bool:
        """Whether it is worse by more than `WORSE`, or not finite."""
        return not self.error - self.best <= WORSE * abs(self.best)

    @property
    def is_clearly_worse(self) -> bool:
        """Whether it is worse by more than chance as well; for a single configuration, chance is not known."""
        deviation = self.difference.standard_error
        by_chance = deviation is None or self.difference.mean <= DEVIATIONS * deviation
        return not math.isfinite(self.error) or (self.is_worse and not by_chance)

    @property
    def sentence(self) -> str:
        """Both errors in words."""
        before = f", and was {self.best:.5g} at best" if math.isfinite(self.best) else ""
        return f"the held-out error is {self.error:.5g}{before}"


def compare(now: Validation, best: Mapping[str, Any] | None) -> Comparison:
    """Compare a validation with the `state` of the best one; with itself if there is none of the same rows and error.

    The held-out set grows while the store does, and samples may be incomplete for a while: the mean over other rows
    would be another figure, whatever the network. Views of one configuration are averaged first, as in `measure`.
    """
    mine = theirs = now.errors
    if best is not None and best["judge"] == now.judge:
        before_of = dict(zip(best["rows"].tolist(), best["errors"].tolist(), strict=True))
        theirs = mine if before_of.keys().isdisjoint(mine) else before_of
    units = [unit for row, unit in zip(now.rows, now.held_out.units, strict=True) if row in theirs]
    rows = [row for row in now.rows if row in theirs]
    ours, others = (group_means(np.array([errors[row] for row in rows]), units) for errors in (mine, theirs))
    error, before = float(ours.mean()), float(others.mean())
    if not now.is_finite:
        return Comparison(math.nan, before, Estimate(math.nan, None, len(ours)), is_best=False)
    return Comparison(error, before, Estimate.of(ours - others), theirs is mine or error < before)
