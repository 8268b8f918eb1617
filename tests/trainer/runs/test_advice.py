"""What curves of known shapes say is worth its seconds."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from read_batches import batch_of

from photonfarm.trainer.networks.inputs import Needs, SceneFrame
from photonfarm.trainer.runs.advice import advise
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.run_folder import METRICS, read_log
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.loop import train


def curve(
    slope: float, training: float, *, noise: float = 0.0, steps: int = 4000, deviation: float = 0.0
) -> list[dict[str, Any]]:
    """The log of a run whose held-out error is step^slope, which ends with `training` of it as its training error."""
    signs = itertools.cycle((1, -1))
    validations = [
        {"kind": "validation", "step": step, "error": step**slope * (1 + noise * next(signs))}
        for step in range(0, steps + 1, 250)
        if step
    ]
    for each in validations:
        error = each["error"]
        each |= {"excess": training * error, "excess_held_out": [error, deviation * error]}
        each["seconds"] = {"train": each["step"] / 10}
    return [{"kind": "train", "step": 50}, *validations, {"kind": "end", "step": steps}]


@pytest.mark.parametrize(
    ("slope", "training", "images_s", "worth"),
    [
        (-0.8, 1.0, None, "more steps"),  # 43 % of them, and the images nothing
        (-0.8, 0.5, None, "more steps"),  # 43 % against 25 %
        (-0.2, 0.4, None, "more images"),  # 13 % against 30 %
        (-0.2, 0.4, 4000.0, "more steps"),  # which take a tenth of the seconds
        (-0.2, 0.4, 400.0, "more images"),
        (-0.01, 0.97, None, "a wider network"),
        (0.3, 0.95, None, "a wider network"),
        (0.3, 0.5, None, "more images"),
        (0.3, -0.5, None, "fresh passes"),
        (-0.8, -0.02, None, "more images"),  # just chance; half of it is excess
        (-0.8, -0.2, None, "fresh passes"),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_slope_and_the_gap_say_what_is_worth_its_seconds(
    slope: float, training: float, images_s: float | None, worth: str, noise: float
) -> None:
    advice = advise(curve(slope, training, noise=noise), images_s)
    assert advice is not None
    assert advice.worth == worth
    assert worth in advice.sentence


def test_the_sentence_has_what_twice_as_much_takes_off_and_its_seconds() -> None:
    advice = advise(curve(-1, 0.6), 7200)
    assert advice is not None
    assert "twice the steps (7 min more) should take 50% off" in advice.sentence
    assert "twice the images (2.0 h more) should take 20% off" in advice.sentence


def test_a_gap_that_may_be_chance_is_not_worth_more_images() -> None:
    """Held-out views may happen to be harder: 0.3 of their error is within two standard errors."""
    for deviation, worth in ((0.0, "more images"), (0.05, "more images"), (0.15, "a wider network")):
        advice = advise(curve(-0.01, 0.7, deviation=deviation))
        assert advice is not None
        assert advice.worth == worth


def test_nothing_is_said_of_runs_that_are_too_short_or_were_not_measured() -> None:
    assert advise([]) is None
    assert advise(curve(-1, 1, steps=500)) is None
    assert advise([{**each, "excess_held_out": [-1e-4, None]} for each in curve(-1, 1)]) is None
    assert advise([{"kind": "validation", "step": step} for step in range(9)]) is None
    assert advise([{**each, "excess_held_out": None} for each in curve(-1, 1)]) is None


@pytest.mark.parametrize("loss", ["linear", "relative"])
def test_the_excess_of_an_image_is_its_error_whatever_the_noise_and_below_0_by_heart(
    make_source: Any, tiny: Any, loss: str
) -> None:
    source, settings = make_source(24, noise=0.5), tiny(loss=loss)
    learner = Learner(SceneFrame.of(source.spec, *source.base(), settings.network), settings, Ranks())
    batch = batch_of(source, range(24), Needs())
    clean = torch.from_numpy(np.stack([source.clean(row) for row in range(24)]))
    off, halves = 1.5 * clean, batch.target.mean(dim=1)
    weight = 1 / (off.mean(dim=-1, keepdim=True) ** 2 + 0.05) if loss == "relative" else 1
    error = float((weight * (off - clean) ** 2).mean())
    assert float(learner.measure_excess(off, batch)) == pytest.approx(error, rel=0.1)
    assert abs(float(learner.measure_excess(clean, batch))) < 0.1 * error
    assert float(learner.measure_excess(halves, batch)) < -0.4 * error


def test_a_run_logs_both_errors_and_says_at_its_end_what_is_worth_its_seconds(
    make_source: Any, tiny: Any, run: Path
) -> None:
    train(make_source(24), tiny(max_steps=12, validate_every=2), run)
    records = read_log(run / METRICS)
    validations = [each for each in records if each["kind"] == "validation"]
    assert all(np.isfinite(each["excess_held_out"]).all() for each in validations)
    assert ["excess" in each for each in validations] == [False, *[True] * (len(validations) - 1)]
    advice = advise(records)
    assert records[-1]["advice"] == (advice and advice.sentence)


def test_views_that_are_black_or_near_are_counted_with_the_squared_gradient_of_their_steps(
    make_source: Any, tiny: Any
) -> None:
    source, settings = make_source(6), tiny()
    learner = Learner(SceneFrame.of(source.spec, *source.base(), settings.network), settings, Ranks())
    usual, black, near = (batch_of(source, rows, Needs()) for rows in (range(2), range(2, 4), range(4, 6)))
    learner.step(0, usual)
    assert learner.take_poor() == {}
    black.target[0] = 0
    learner.step(1, black)
    assert learner.take_poor() == {"samples": 0.5, "gradient": 1.0}
    near.inputs.depth[:, :8] = 1e-3
    learner.step(2, near)
    learner.step(3, usual)
    shares = learner.take_poor()
    assert shares["samples"] == 0.5
    assert 0 < shares["gradient"] < 1
    assert learner.take_poor() == {}


def test_a_sample_of_which_one_half_is_black_counts_for_networks_of_halves_only_if_both_are(
    make_source: Any, tiny: Any
) -> None:
    source, settings = make_source(2), tiny(network={"width": 4, "architecture": "denoise_1"})
    learner = Learner(SceneFrame.of(source.spec, *source.base(), settings.network), settings, Ranks())
    batch = batch_of(source, range(2), Needs(points=False, kept=1))
    batch.target[0, 0] = 0
    learner.step(0, batch)
    assert learner.take_poor() == {}
    batch.target[0, 1] = 0
    learner.step(1, batch)
    assert learner.take_poor() == {"samples": 0.5, "gradient": 1.0}
    batch.target[1] = torch.nan
    learner.step(2, batch)
    assert learner.take_poor() == {}, "JSON has no number for it"
