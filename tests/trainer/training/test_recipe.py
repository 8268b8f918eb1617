"""Schedules of the rate, and the average of the weights by which a run predicts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from held_out_errors import held_out_errors
from read_batches import batch_of

from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import Needs, SceneFrame
from photonfarm.trainer.predictors.evaluation import read_batches
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT, INITIAL, METRICS
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training import loop
from photonfarm.trainer.training.learner import Learner, compute_rate
from photonfarm.trainer.training.loop import train

Weights = dict[str, torch.Tensor]


def state(run: Path) -> dict[str, Weights]:
    found = checkpoint.load(run / CHECKPOINT)
    return {"raw": found["network"], "averaged": found["average"]["weights"] if found["average"] else {}}


def same(one: Weights, other: Weights) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_the_cosine_rises_in_equal_parts_and_falls_to_nothing_at_the_last_step() -> None:
    settings = TrainSettings(schedule="cosine", warm_up=0.1, max_steps=100, learning_rate=2.0, decay=0.1)
    rates = [compute_rate(step, settings) for step in range(101)]
    assert rates[:10] == pytest.approx([0.2 * step for step in range(1, 11)])
    assert rates[10] == 2.0
    assert rates[55] == pytest.approx(1.0), "half of it in the middle of the 90 steps"
    assert rates[40] == pytest.approx(1 + np.cos(np.pi / 3))
    assert 0 < rates[99] < 1e-3
    assert rates[100] == 0
    assert all(np.diff(rates[10:]) < 0)


def test_a_run_that_goes_on_with_more_steps_follows_the_schedule_of_these(make_source, tiny, run, monkeypatch) -> None:
    monkeypatch.setattr(loop, "LOG_EVERY", 1)
    for steps in (4, 8):
        train(make_source(24), tiny(schedule="cosine", warm_up=0.25, max_steps=steps, learning_rate=1e-3), run)
    rates = [record["rate"] for record in run_folder.read_log(run / METRICS) if record["kind"] == "train"]
    shares = [1, 1, 0.75, 0.25]  # of 4 steps, of which one is the rise
    shares += [(1 + np.cos(np.pi * part / 6)) / 2 for part in (2, 3, 4, 5)]  # of 8, of which two are
    assert rates == pytest.approx([1e-3 * share for share in shares])


def take_a_step(source: Any, width: int, layer_rates: str) -> tuple[Learner, Weights, float]:
    """A learner after its first step, its weights before, and by how much its image has changed (root mean square)."""
    network = NetworkSettings(architecture="cnn", width=width)
    settings = TrainSettings(network=network, layer_rates=layer_rates, learning_rate=1e-4)
    learner = Learner(SceneFrame.of(source.spec, *source.base(), network), settings, Ranks())
    before = {name: weight.detach().clone() for name, weight in learner.network.named_parameters()}
    batch = batch_of(source, range(4), Needs(points=False))
    images = [learner.network(batch.inputs).detach()]
    learner.step(0, batch)
    images.append(learner.network(batch.inputs).detach())
    return learner, before, float((images[1] - images[0]).square().mean().sqrt())


def test_a_scaled_layer_has_144_inputs_th_of_the_rate_and_one_of_fewer_inputs_all_of_it(make_source) -> None:
    """Adam's first step moves every weight that has a gradient by the rate."""
    learner, before, _ = take_a_step(make_source(4), 32, "scaled")
    for name, weight in learner.network.named_parameters():
        inputs = weight[0].numel() if name.endswith("weight") else 1
        moved = float((weight.detach() - before[name]).abs().max())
        assert moved == pytest.approx(1e-4 * min(1, 144 / inputs), rel=0.01), name


def test_one_rate_changes_an_image_of_four_times_the_width_as_much_only_if_it_is_scaled(make_source) -> None:
    source = make_source(4)
    equal, scaled = ([take_a_step(source, width, how)[2] for width in (16, 64)] for how in ("equal", "scaled"))
    assert equal[1] > 5 * equal[0]
    assert scaled[1] < 2.5 * scaled[0]


def test_the_average_is_the_running_mean_that_one_works_out_by_hand(make_source, tiny, run, tmp_path) -> None:
    """The mean is of the weights after each of four steps, with 0.1, 2/11, 0.2 and 0.2 of what there was before."""
    raw = []
    for steps in range(1, 5):
        train(make_source(24), tiny(max_steps=steps), tmp_path / str(steps))
        raw.append(state(tmp_path / str(steps))["raw"])
    train(make_source(24), tiny(max_steps=4, average=0.2), run)
    found = state(run)
    assert same(found["raw"], raw[-1]), "training goes on from the weights as they are"
    for name, mean in checkpoint.load(run / INITIAL)["network"].items():
        for weights, kept in zip(raw, (0.1, 2 / 11, 0.2, 0.2), strict=True):
            mean = kept * mean.double() + (1 - kept) * weights[name].double()
        torch.testing.assert_close(found["averaged"][name].double(), mean, rtol=1e-6, atol=1e-7)


def test_whatever_predicts_from_a_run_has_its_averaged_weights(make_source, tiny, run) -> None:
    outcome = train(make_source(24), tiny(average=0.9), run)
    found, trained = state(run), TrainedRun.load(run)
    assert same(trained.weights, found["averaged"])
    assert not same(found["averaged"], found["raw"])
    assert held_out_errors(lambda: make_source(24), run).last == pytest.approx(outcome.last_error, rel=1e-6)
    with Feed(make_source(24), trained.settings) as feed:
        base, rows = feed.base, [row for row, side in feed.arrivals()[0] if side == "held-out"]
        batch = next(read_batches(feed, rows, 3))
        network = trained.network(feed.spec, base)
        network.load_state_dict(found["raw"])
        images = trained.predictor(feed.spec, base, "cpu")(batch)
        with torch.no_grad():
            by_raw = network(batch.inputs).numpy()
            network.load_state_dict(found["averaged"])
            by_averaged = network(batch.inputs).numpy()
    assert np.array_equal(images, by_averaged)
    assert not np.allclose(images, by_raw)


def test_an_average_may_begin_and_end_where_a_run_goes_on(make_source, tiny, run, tmp_path) -> None:
    train(make_source(24), tiny(max_steps=4), run)
    train(make_source(24), tiny(max_steps=5, average=0.5), run)
    before = (json.loads(line) for line in (run / METRICS).read_text().splitlines())
    (changed,) = [record["changes"] for record in before if record["kind"] == "changes"]
    assert changed["average"] == [0.0, 0.5]
    first = state(run)
    assert checkpoint.load(run / CHECKPOINT)["average"]["steps"] == 1
    assert not same(first["averaged"], first["raw"])
    train(make_source(24), tiny(max_steps=6), run)
    assert state(run)["averaged"] == {}
    assert same(TrainedRun.load(run).weights, state(run)["raw"])
