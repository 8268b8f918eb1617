"""Runs that learn the noise of their samples by heart: they end, with the weights of the least held-out error."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room import analytic_spec
from analytic_room_samples import AnalyticSource

from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.cli import show
from photonfarm.trainer.predictors.evaluation import HeldOutErrors
from photonfarm.trainer.runs.advice import LEARNED_BY_HEART, advise
from photonfarm.trainer.runs.checkpoint import load
from photonfarm.trainer.runs.run_folder import CHECKPOINT, GOOD, METRICS, read_log
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.loop import Hooks, train
from photonfarm.trainer.training.validation import BestValidations, Validation

NOISE = 1.5
"""The relative deviation of each value of a half."""


class GrowingSource(AnalyticSource):
    """Samples of plans of 16 each, rendered once."""

    def __init__(self, *of: Any, **how: Any) -> None:
        super().__init__(*of, **how)
        self.read = cache(self.read)

    @property
    def plan_requests(self) -> list[dict[str, Any]]:
        return [{"samples": 16}] * (self.planned // 16)


@pytest.fixture
def by_heart() -> Callable[..., TrainSettings]:
    """Settings by which a network learns some eight noisy images by heart within 300 steps."""

    def settings(**changes: Any) -> TrainSettings:
        network = NetworkSettings(architecture="cnn", width=16)
        described = {"network": network, "batch": 2, "hold_out": 0.6, "poll_seconds": 0.01, "average": 0.9}
        described |= {"learning_rate": 5e-3, "layer_rates": "scaled", "max_steps": 400, "validate_every": 40}
        return TrainSettings.model_validate({**described, **changes})

    return settings


def source_of(samples: int) -> AnalyticSource:
    return GrowingSource(analytic_spec(16, 256), samples, noise=NOISE)


def test_a_run_that_learns_noise_by_heart_ends_with_its_best_weights_and_goes_on_with_further_samples(
    by_heart, run: Path, capsys
) -> None:
    outcome = train(source_of(16), by_heart(), run, Hooks(on_record=show.print_record))
    log = read_log(run / METRICS)
    *validations, last = (record for record in log if record["kind"] == "validation")
    (found,) = (record for record in log if record["kind"] == "recovered")
    assert outcome.reason == LEARNED_BY_HEART == log[-1]["reason"] == found["cause"]
    assert outcome.step == last["step"] == validations[-1]["step"] < 400
    assert validations[-1]["excess"] < 0
    least = min(validations, key=lambda each: each["excess_held_out"][0])
    assert found["back_to"] == least["step"] < outcome.step
    assert last["error"] == pytest.approx(least["error"])
    assert last["error"] < validations[-1]["error"] / 1.1
    said = capsys.readouterr().err
    assert f"learns its samples by heart; ends with the weights of step {least['step']}" in said
    found_worth = advise(log)
    assert found_worth is not None
    assert found_worth.worth == "fresh passes"
    assert log[-1]["advice"] == found_worth.sentence

    kept, ended = (load(run / name)["average"]["weights"] for name in (GOOD, CHECKPOINT))
    assert load(run / GOOD)["step"] == least["step"]
    assert all(torch.equal(kept[name], weight) for name, weight in ended.items())

    again = train(source_of(16), by_heart(), run)
    assert (again.reason, again.step) == (LEARNED_BY_HEART, outcome.step), "nothing has come that it could go on with"
    further = train(source_of(64), by_heart(max_steps=outcome.step + 20), run)
    assert (further.reason, further.step) == ("steps", outcome.step + 20)


@pytest.mark.slow
def test_a_run_of_as_noisy_images_that_are_enough_goes_on_to_its_last_step(by_heart, run: Path) -> None:
    outcome = train(source_of(96), by_heart(max_steps=200, validate_every=20), run)
    assert (outcome.reason, outcome.step) == ("steps", 200)


def of_excesses(step: int, *excesses: float) -> Validation:
    """A validation of so many configurations, whose errors are all alike."""
    values, units = np.ones(len(excesses)), tuple(bytes([n]) for n in range(len(excesses)))
    held_out = HeldOutErrors(Estimate.of(group_means(values, units)), 0.0, values, values, units)
    return Validation(step, (*range(len(excesses)),), held_out, excesses=dict(enumerate(excesses)))


@pytest.mark.parametrize(
    ("now", "training", "is_good", "has_risen", "learns_by_heart"),
    [
        ((1.2, 1.3, 1.2), -0.2, False, True, True),
        ((1.2, 1.3, 1.2), 0.04, False, True, True),  # above 0: too few images rather than noise
        ((1.2, 1.3, 1.2), 0.06, False, True, False),
        ((1.2, 1.3, 1.2), 0.5, False, True, False),  # worse on both, as where a run diverges
        ((1.2, 1.3, 1.2), None, False, True, False),
        ((1.05, 1.06, 1.05), -0.2, False, False, False),  # by less than a tenth
        ((2.0, 0.9, 1.0), 0.1, True, False, False),  # one view, which may be chance
        ((2.0, 0.9, 1.0), -0.2, False, False, False),
        ((0.9, 0.8, 0.9), -0.2, True, False, False),  # still better on held-out views
    ],
)
def test_samples_are_learned_by_heart_where_their_excess_halves_while_the_held_out_one_rises_clearly_above_its_least(
    now: tuple[float, ...], training: float | None, is_good: bool, has_risen: bool, learns_by_heart: bool
) -> None:
    best = BestValidations()
    best.place(of_excesses(0, 3.0, 3.0, 3.0), None)
    best.place(of_excesses(1, 1.0, 1.0, 1.0), 0.1)
    resumed = BestValidations()
    resumed.restore(best.state())
    for each in (best, resumed):
        found = each.place(of_excesses(2, *now), training)
        told = found.is_good, found.rise is not None, found.learns_by_heart
        assert told == (is_good, has_risen, learns_by_heart)
