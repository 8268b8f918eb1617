"""Runs that get much worse than they were, and go back: by their held-out error, by their loss, and at their end."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from photonfarm.core.errors import StoreError
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.cli import show
from photonfarm.trainer.predictors.evaluation import HeldOutErrors
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.run_folder import CHECKPOINT, GOOD, METRICS
from photonfarm.trainer.training import loop
from photonfarm.trainer.training.good_state import NEXT, SNAPSHOT_EVERY
from photonfarm.trainer.training.learner import DivergedError, Learner
from photonfarm.trainer.training.loop import Hooks, train
from photonfarm.trainer.training.recent_losses import FACTOR, LOOK_EVERY
from photonfarm.trainer.training.validation import UP_TO_WHITE, Validation, compare, validate

TOO_HIGH = {"learning_rate": 0.05, "max_steps": 30}
"""Of a rate by which the tiny network diverges, for as long as it takes to find a lower one."""


RISING = {"learning_rate": 0.05, "seed": 1, "schedule": "cosine", "warm_up": 0.5}
"""Of a rate that rises until the tiny network diverges, after some 50 steps."""


def records(run: Path, kind: str) -> list[dict[str, Any]]:
    return [record for record in run_folder.read_log(run / METRICS) if record["kind"] == kind]


def validation(errors: dict[int, float], views: int = 1, step: int = 0) -> Validation:
    """A validation of rows, of which each `views` are of one configuration."""
    values, units = np.array([*errors.values()]), tuple(bytes([row // views]) for row in errors)
    held_out = HeldOutErrors(Estimate.of(group_means(values, units)), 0.0, values, values, units)
    return Validation(step, (*errors,), held_out)


def best(errors: dict[int, float]) -> dict[str, Any]:
    return validation(errors).state()


def spoilt(source: Any, reads: Callable[[int], bool]) -> Any:
    """The source, of which the reads of these numbers hold a value that is not finite."""
    honest = source.read

    def read(row: int) -> Any:
        sample = honest(row)
        if reads(len(source.reads)):
            sample.radiance[0, 3, 3, 0] = np.nan
        return sample

    source.read = read
    return source


def as_if(monkeypatch: pytest.MonkeyPatch, errors: dict[int, Sequence[float]]) -> None:
    """Have validations find these errors of rows 0, 1, … at each step, whatever the network."""

    def validate(predict: Any, step: int, found: Any, show: Any, **how: Any) -> Validation:
        list(found)
        return validation(dict(enumerate(errors[step])), step=step)

    monkeypatch.setattr(loop, "validate", validate)


# ---------------------------------------------------------------------------------------------------------- comparisons


def test_a_validation_is_held_against_the_best_over_the_rows_of_both() -> None:
    """The mean over all rows has doubled, and on those that were there before it has fallen."""
    found = compare(validation({0: 0.9, 1: 1.9, 2: 9.0, 3: 9.0}), best({0: 1.0, 1: 2.0, 7: 0.0}))
    assert (found.error, found.best) == pytest.approx((1.4, 1.5))
    assert found.is_best
    assert not found.is_worse


def test_views_of_a_configuration_are_averaged_first() -> None:
    """Rows 0, 1 | 2, 3 | 4: the mean over configurations, and its standard error over three pairs."""
    before = dict.fromkeys(range(5), 1.0)
    found = compare(validation({0: 2.0, 1: 4.0, 2: 2.0, 3: 2.0, 4: 1.0}, views=2), best(before))
    assert (found.error, found.best) == (2.0, 1.0)
    assert found.difference == Estimate.of(np.array([2.0, 1.0, 0.0]))


@pytest.mark.parametrize(
    ("now", "worse", "clearly"),
    [
        ([1.09, 1.09, 1.09, 1.09], False, False),  # beyond chance, and by less than a tenth
        ([1.11, 1.12, 1.11, 1.12], True, True),
        ([2.0, 1.0, 1.0, 1.0], True, False),  # 0.25 ± 0.25
        ([0.5, 0.4, 0.5, 0.4], False, False),
        ([math.inf, 1.0, 1.0, 1.0], True, True),
        ([math.nan, 1.0, 1.0, 1.0], True, True),
    ],
)
def test_worse_is_by_more_than_a_tenth_and_clearly_so_beyond_two_standard_errors(
    now: list[float], worse: bool, clearly: bool
) -> None:
    with np.errstate(invalid="ignore"):
        found = compare(validation(dict(enumerate(now))), best(dict.fromkeys(range(4), 1.0)))
    assert (found.is_worse, found.is_clearly_worse) == (worse, clearly)


def test_of_a_single_configuration_nothing_is_clear_but_what_is_not_finite() -> None:
    found = compare(validation({0: 50.0, 1: 70.0}, views=2), best({0: 1.0, 1: 1.0}))
    assert found.is_worse
    assert not found.is_clearly_worse
    assert compare(validation({0: math.nan}), best({0: 1.0})).is_clearly_worse


def test_where_no_row_of_the_best_was_measured_again_the_best_begins_anew() -> None:
    found = compare(validation({5: 50.0, 6: 70.0}), best({0: 1.0, 1: 1.0}))
    assert found.is_best
    assert not found.is_worse
    assert not compare(validation({5: math.nan}), None).is_best


def test_lamps_that_got_worse_are_not_held_against_a_run_whose_loss_cares_little_for_them() -> None:
    """Seen is a lamp of 100 in one block of 16, which the network takes for 2 now; the rest is right."""
    image = np.full((1, 32, 32, 3), 0.5, np.float32)
    image[:, :8, :8] = 100.0
    batch = batch_of(image, image)
    learned, before = image.clip(max=2.0), image.clip(max=50.0) + 0.1

    for loss, worse in [("linear", True), ("relative", False), ("paired", False)]:
        was = at(batch, before, loss)
        assert compare(at(batch, learned, loss), was.state()).is_worse is worse
    assert at(batch, learned, "relative").held_out.shown == pytest.approx(0.0)
    assert at(batch, before, "relative").held_out.shown == pytest.approx(0.01 * 15 / 16)


def test_noise_does_not_make_a_dark_network_look_better_than_the_right_one() -> None:
    """One pixel in eight is bright in each half, and most of its light is above white."""
    rng = np.random.default_rng(0)
    halves = np.where(rng.random((2, 64, 64, 1)) < 1 / 8, 2.4, 0.0).repeat(3, axis=-1).astype(np.float32)
    right, dark = (np.full((1, 64, 64, 3), value, np.float32) for value in (0.3, 0.15))
    batch = batch_of(halves[:1], halves[1:])
    was = at(batch, dark, "relative")
    found = compare(at(batch, right, "relative"), was.state())
    assert found.is_best
    assert found.best == pytest.approx(0.15**2, rel=0.2)


def batch_of(half_a: Any, half_b: Any) -> Any:
    """One sample (1, H, W, 3), as far as a validation looks at it."""
    return SimpleNamespace(
        rows=(0,),
        units=(b"a",),
        inputs=SimpleNamespace(noisy=None),
        target=torch.from_numpy(np.stack([half_a, half_b], axis=1)),
    )


def at(batch: Any, predicted: Any, loss: str) -> Validation:
    return validate(lambda _: predicted, 0, iter([batch]), loss=loss)


def test_a_best_of_all_light_is_none_for_a_run_that_is_judged_by_light_up_to_white() -> None:
    now, before = replace(validation({0: 50.0}), judge=UP_TO_WHITE), validation({0: 0.5})
    assert compare(now, before.state()).is_best
    assert compare(now, replace(before, judge=UP_TO_WHITE).state()).is_worse


# ----------------------------------------------------------------------------------------------------------------- runs


def test_a_run_of_too_high_a_rate_recovers_and_ends_far_better_than_without(
    make_source, tiny, run, tmp_path, capsys
) -> None:
    outcome = train(make_source(48), tiny(**TOO_HIGH), run, Hooks(on_record=show.print_record))
    without = train(make_source(48), tiny(**TOO_HIGH, recover=False), tmp_path / "without")
    assert outcome.step == 30
    assert outcome.last_error < 1e-3 * without.last_error
    found, log = records(run, "recovered"), (run / METRICS).read_text()
    assert "NaN" not in log
    assert "Infinity" not in log
    halved = [record for record in found if record["cause"] != "end"]
    assert [record["recoveries"] for record in halved] == [*range(1, len(halved) + 1)]
    assert [record["rate_factor"] for record in halved] == [0.5**n for n in range(1, len(halved) + 1)]
    assert all(record["back_to"] <= record["step"] for record in found)
    by_error = next(record for record in found if record["cause"] == "held-out error")
    assert by_error["errors"]["now"] > 1.1 * by_error["errors"]["best"]
    assert checkpoint.load(run / CHECKPOINT)["recovery"]["rate_factor"] == halved[-1]["rate_factor"]
    said = [line for line in capsys.readouterr().err.splitlines() if "goes on from the weights" in line]
    assert len(said) == len(halved)
    assert f"goes on from the weights of step {halved[0]['back_to']}, at 0.5 of the rate" in said[0]
    assert records(tmp_path / "without", "recovered") == []
    assert not (tmp_path / "without" / GOOD).exists()


@pytest.mark.parametrize("loss", ["linear", "relative"])
def test_a_run_that_diverges_from_its_first_step_is_caught_by_its_tenth(
    make_source, tiny, run, tmp_path, loss: str
) -> None:
    """No validation on the way finds it, and its own losses are all of a run that diverges."""
    settings = tiny(learning_rate=0.02, loss=loss, max_steps=30, validate_every=30, checkpoint_every=30)
    without = train(make_source(48), settings.model_copy(update={"recover": False}), tmp_path / "without")
    outcome = train(make_source(48), settings, run)
    first = records(run, "recovered")[0]
    assert (first["cause"], first["step"], first["back_to"]) == ("loss", LOOK_EVERY, 0)
    assert first["losses"]["now"] > FACTOR * first["losses"]["usual"]
    assert outcome.last_error < 0.1 * without.last_error


@pytest.mark.slow
def test_a_run_whose_rate_rises_until_it_diverges_is_caught_within_thirty_steps_each_time_and_ends_well(
    make_source, tiny, run, tmp_path, monkeypatch, capsys
) -> None:
    """No validation on the way finds it."""
    losses, honest = [], Learner.step

    def step(learner: Learner, number: int, batch: Any) -> torch.Tensor:
        losses.append(loss := honest(learner, number, batch))
        return loss

    settings = tiny(**RISING, max_steps=300, validate_every=300, checkpoint_every=100)
    without = train(make_source(48), settings.model_copy(update={"recover": False}), tmp_path / "without")
    monkeypatch.setattr(Learner, "step", step)
    outcome = train(make_source(48), settings, run, Hooks(on_record=show.print_record))
    found = [record for record in records(run, "recovered") if record["cause"] == "loss"]
    assert len(found) >= 2
    assert capsys.readouterr().err.count(" (usually up to ") == len(found)
    for before, record in pairwise([{"step": 0}, *found]):
        assert record["back_to"] >= record["step"] - SNAPSHOT_EVERY - 30
        since, limit = range(before["step"], record["step"]), FACTOR * record["losses"]["usual"]
        assert next(n for n in since if losses[n] > limit) >= record["step"] - 30
    assert outcome.last_error < 0.1 * without.last_error
    assert outcome.last_error < 1.2 * train(make_source(48), tiny(max_steps=300), tmp_path / "calm").last_error


def test_a_loss_that_is_not_finite_costs_a_run_a_few_dozen_steps(make_source, tiny, run, monkeypatch, capsys) -> None:
    """Batches of 3 are read after 6 held-out samples at most, and 2 ahead: 3 × 75 reads are some 70 steps."""
    monkeypatch.setattr(loop, "LOG_EVERY", LOOK_EVERY)
    settings = tiny(validate_every=1000, checkpoint_every=1000, max_steps=120)
    source = spoilt(make_source(24), lambda reads: reads == 225)
    assert train(source, settings, run, Hooks(on_record=show.print_record)).reason == "steps"
    said = "step 80: the loss is not finite; goes on from the weights of step 50, at 0.5 of the rate"
    assert said in capsys.readouterr().err.splitlines()
    (found,) = records(run, "recovered")
    wanted = {
        "kind": "recovered",
        "cause": "loss",
        "what": "loss",
        "errors": None,
        "losses": {"now": None, "usual": None},
    }
    assert found == {**wanted, "recoveries": 1, "rate_factor": 0.5, "step": 80, "back_to": 50}
    rates = {record["step"]: record["rate"] for record in records(run, "train")}
    assert rates == {n: 5e-4 if n < 80 else 2.5e-4 for n in range(10, 121, 10) if n != 80}, "no loss to tell of that"
    assert checkpoint.load(run / CHECKPOINT)["following"]["drawn"] == 120, "the order of samples goes on"


def test_without_recovery_a_loss_that_is_not_finite_ends_the_run_before_it_is_in_a_checkpoint(
    make_source, tiny, run
) -> None:
    source = spoilt(make_source(24), lambda reads: reads > 36)
    with pytest.raises(DivergedError, match=r"step 12: the loss is not finite"):
        train(source, tiny(max_steps=40, validate_every=100, checkpoint_every=4, recover=False), run)
    assert checkpoint.load(run / CHECKPOINT)["step"] == 8
    weights = checkpoint.load(run / CHECKPOINT)["network"]
    assert all(torch.isfinite(weight).all() for weight in weights.values())


def test_without_recovery_a_held_out_error_that_is_not_finite_ends_the_run(make_source, tiny, run, monkeypatch) -> None:
    as_if(monkeypatch, {0: [1.0], 4: [math.nan]})
    with pytest.raises(DivergedError, match="held-out error of step 4 is nan"):
        train(make_source(24), tiny(validate_every=4, recover=False), run)
    assert [record["step"] for record in records(run, "validation")] == [0]


def test_it_gives_up_after_eight_times(make_source, tiny, run) -> None:
    source = spoilt(make_source(24), lambda reads: reads > 20)
    with pytest.raises(DivergedError) as diverged:
        train(source, tiny(max_steps=100, validate_every=100, checkpoint_every=100), run)
    assert diverged.value.exit_code == 8
    assert [record["recoveries"] for record in records(run, "recovered")] == [*range(1, 9)]


def test_the_weights_their_average_and_the_optimisers_memory_are_those_of_the_last_good_validation(
    make_source, tiny, run, tmp_path, monkeypatch
) -> None:
    """Step 8 is clearly worse than step 4, so that step 9 is taken from what there was at 4, at half the rate."""
    settings = tiny(validate_every=4, checkpoint_every=1, average=0.9)
    train(make_source(24), settings.model_copy(update={"max_steps": 4}), tmp_path / "four")
    as_if(monkeypatch, {0: [1.0] * 3, 4: [0.5] * 3, 8: [0.8, 0.9, 0.8]})

    def stop_at_eight(record: dict[str, Any]) -> None:
        if record["kind"] == "recovered":
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(make_source(24), settings, run, Hooks(on_record=stop_at_eight))
    found = records(run, "recovered")
    errors = {"now": pytest.approx(0.8333, abs=1e-4), "best": 0.5}
    assert [(r["step"], r["back_to"], r["errors"]) for r in found] == [(8, 4, errors)]
    kept, four = checkpoint.load(run / GOOD), checkpoint.load(tmp_path / "four" / CHECKPOINT)
    assert kept["step"] == 4
    for part in ("network", "average", "optimiser_state"):
        told = [json.dumps(state[part], default=torch.Tensor.tolist) for state in (kept, four)]
        assert told[0] == told[1]
    assert TrainedRun.load(run, GOOD).settings == settings, "it can be looked at as a checkpoint can"


def test_what_it_goes_back_to_is_not_trained_on_from_there(make_source, tiny, run, monkeypatch) -> None:
    """Twice to the same step: its weights and the optimiser's memory are as they were the first time."""
    settings = tiny(validate_every=4, checkpoint_every=1, max_steps=16)
    as_if(monkeypatch, {0: [1.0] * 3, 4: [0.5] * 3, 8: [0.8, 0.9, 0.8], 12: [0.8, 0.9, 0.8], 16: [0.8, 0.9, 0.8]})
    train(make_source(24), settings, run)
    last, kept = checkpoint.load(run / CHECKPOINT), checkpoint.load(run / GOOD)
    assert [(r["cause"], r["back_to"]) for r in records(run, "recovered")] == [
        ("held-out error", 4),
        ("held-out error", 4),
        ("end", 4),
    ]
    assert last["recovery"]["rate_factor"] == 0.25
    for part in ("network", "optimiser_state"):
        told = [json.dumps(state[part], default=torch.Tensor.tolist) for state in (last, kept)]
        assert told[0] == told[1]


def test_a_run_that_ends_worse_than_it_was_ends_with_the_last_good_weights_and_says_so(
    make_source, tiny, run, tmp_path, monkeypatch, capsys
) -> None:
    """One validation cannot tell whether that is chance: so the run does not go back on the way."""
    train(make_source(24), tiny(max_steps=5), tmp_path / "five")
    noisy = [1.5, 0.1, 0.5]
    as_if(monkeypatch, {0: [1.0] * 3, 5: [0.5] * 3, 10: noisy, 12: noisy})
    train(make_source(24), tiny(), run, Hooks(on_record=show.print_record))
    told = [(r["kind"], r["step"]) for r in run_folder.read_log(run / METRICS)]
    assert told[2:] == [("validation", 10), ("validation", 12), ("recovered", 12), ("validation", 12), ("end", 12)]
    (found,) = records(run, "recovered")
    assert (found["cause"], found["back_to"], found["rate_factor"], found["recoveries"]) == ("end", 5, 1.0, 0)
    ended, five = (checkpoint.load(folder / CHECKPOINT)["network"] for folder in (run, tmp_path / "five"))
    assert all(torch.equal(ended[name], five[name]) for name in five)
    said = "step 12: held-out error 0.70000 (best so far 0.50000); ends with the weights of step 5"
    assert said in capsys.readouterr().err.splitlines()


def test_what_is_kept_is_refused_where_it_is_damaged_and_missed_by_nobody_where_it_is_gone(
    make_source, tiny, run
) -> None:
    train(make_source(24), tiny(), run)
    whole = (run / GOOD).read_bytes()
    (run / GOOD).write_bytes(whole[:-2000])
    with pytest.raises(StoreError, match=r"good\.safetensors.*run goes on"):
        train(make_source(24), tiny(max_steps=14), run)
    (run / GOOD).unlink()
    (run / NEXT).write_bytes(whole)
    assert train(make_source(24), tiny(max_steps=14), run).step == 14
    assert not (run / NEXT).exists()
    (run / GOOD).unlink()
    assert train(make_source(24), tiny(max_steps=16), run).step == 16


@pytest.mark.parametrize("how", ["its file is gone", "it was told not to recover for a while"])
def test_with_nothing_to_go_back_to_the_best_begins_anew_as_well(make_source, tiny, run, monkeypatch, how: str) -> None:
    as_if(monkeypatch, {0: [0.5] * 3, 5: [0.5] * 3, 6: [0.5] * 3, 10: [0.8, 0.9, 0.8], 12: [0.8, 0.9, 0.8]})
    train(make_source(24), tiny(max_steps=5), run)
    if how == "its file is gone":
        (run / GOOD).unlink()
    else:
        train(make_source(24), tiny(max_steps=6, recover=False), run)
    train(make_source(24), tiny(), run)
    assert records(run, "recovered") == []
    assert checkpoint.load(run / GOOD)["step"] == 12


def test_a_run_that_begins_anew_keeps_nothing_of_an_older_one(make_source, tiny, run) -> None:
    train(make_source(24), tiny(), run)
    (run / CHECKPOINT).unlink()
    train(make_source(24), tiny(max_steps=2, recover=False), run)
    assert not (run / GOOD).exists()


def test_a_run_that_goes_on_keeps_its_rate_and_counts_on(make_source, tiny, run) -> None:
    train(make_source(48), tiny(**TOO_HIGH), run)
    before = checkpoint.load(run / CHECKPOINT)["recovery"]
    train(make_source(48), tiny(**{**TOO_HIGH, "max_steps": 31}), run)
    after = checkpoint.load(run / CHECKPOINT)["recovery"]
    assert before["recoveries"] == after["recoveries"] > 0
    assert before["rate_factor"] == after["rate_factor"] == 0.5 ** before["recoveries"]
