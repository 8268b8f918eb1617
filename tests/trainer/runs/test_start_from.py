"""Runs that begin with the weights of another run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.trainer import service
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT, INITIAL, METRICS, read_log, read_settings
from photonfarm.trainer.training.loop import Hooks, train

NETWORK = {"width": 4, "architecture": "light_transport", "points": 64, "descriptor": 2}


@pytest.fixture
def begin(make_source: Callable[..., Any], tiny: Callable[..., Any], tmp_path: Path) -> Callable[..., Path]:
    """Train a run of this name by settings, of the analytic room or, by `photons`, of another one."""

    def trained(name: str, photons: int = 0, steps: int = 3, **settings: Any) -> Path:
        described = tiny(**{"network": NETWORK, "average": 0.9, "max_steps": steps, **settings})
        train(make_source(24, photons=photons), described, tmp_path / name)
        return tmp_path / name

    return trained


def predicting(run: Path) -> dict[str, torch.Tensor]:
    return checkpoint.load(run / CHECKPOINT)["average"]["weights"]


def test_a_run_begins_with_the_weights_that_another_predicts_by(begin: Callable[..., Path]) -> None:
    first = begin("first")
    second = begin("second", start_from=str(first), seed=5, learning_rate=1e-12)
    (said,) = (record for record in read_log(second / METRICS) if record["kind"] == "start")
    assert (said["run"], said["of_step"], said["anew"]) == (str(first), 3, [])
    for name, tensor in predicting(first).items():
        assert torch.equal(tensor, checkpoint.load(second / INITIAL)["network"][name])
        torch.testing.assert_close(predicting(second)[name], tensor, rtol=0, atol=1e-9)
    assert read_settings(second).start_from == str(first)
    begin(
        "second", start_from=str(first), seed=5, learning_rate=1e-12, steps=4
    )  # goes on, whatever became of the other
    with pytest.raises(SpecError):
        begin("second", seed=5, steps=5)


def test_a_start_that_was_trained_on_what_is_held_out_now_is_said(
    begin: Callable[..., Path], make_source: Callable[..., Any], tiny: Callable[..., Any], tmp_path: Path
) -> None:
    begin("first", hold_out=0.25)
    for name, before, photons, share, knows in (
        ("same", "first", 0, 0.25, False),
        ("more", "first", 0, 0.5, True),
        ("still", "more", 0, 0.5, True),
        ("other", "first", 8, 0.5, False),
        ("back", "other", 0, 0.5, True),
    ):
        start = str(tmp_path / before)
        settings = tiny(network=NETWORK, max_steps=1, average=0.9, hold_out=share, start_from=start)
        said: list[str] = []
        train(make_source(24, photons=photons), settings, tmp_path / name, Hooks(on_wait=said.append))
        assert read_log(tmp_path / name / METRICS)[0]["knows_held_out"] == knows
        assert any("hold_out = 0.25" in sentence for sentence in said) == knows
        assert TrainedRun.load(tmp_path / name).hold_out == (0.25 if knows else share)


def test_descriptors_of_another_scenes_points_begin_anew(begin: Callable[..., Path]) -> None:
    first = begin("first")
    fresh, second = begin("fresh", photons=8), begin("second", photons=8, start_from=str(first))
    untrained, begun = (checkpoint.load(run / INITIAL)["network"] for run in (fresh, second))
    assert torch.equal(begun["descriptor"], untrained["descriptor"])
    rest = begun.keys() - {"descriptor"}
    assert all(torch.equal(begun[name], predicting(first)[name]) for name in rest)
    fewer = begin("fewer", start_from=str(first), network={**NETWORK, "points": 32})
    assert read_log(fewer / METRICS)[0]["anew"] == ["descriptor"]


@pytest.mark.parametrize(
    ("network", "named"),
    [
        ({"architecture": "cnn"}, "architecture = 'light_transport' there, and 'cnn'"),
        ({"width": 8, "octaves": 1}, "width = 4 there, and 8 .*octaves = 2 there, and 1"),
        ({"maxima": "relative"}, "maxima"),
    ],
)
def test_weights_of_another_network_are_refused_by_each_setting(
    begin: Callable[..., Path], network: dict[str, Any], named: str
) -> None:
    first = begin("first", steps=1)
    with pytest.raises(SpecError, match=named):
        begin("second", start_from=str(first), network={**NETWORK, **network})
    with pytest.raises(StoreError):
        begin("third", start_from=str(first.with_name("none")))


def test_a_folder_that_holds_no_run_is_refused_before_samples_are_waited_for(tmp_path: Path) -> None:
    changes = {"start_from": str(tmp_path / "none"), "max_seconds": 60.0}
    with pytest.raises(StoreError, match="there is no such run"):
        service.run("cornell", tmp_path / "store", tmp_path / "run", "small", changes, log=str)


def test_a_start_that_is_refused_leaves_no_folder(begin: Callable[..., Path], tmp_path: Path) -> None:
    changes = {**NETWORK, "start_from": str(begin("first", steps=1)), "width": 8}
    with pytest.raises(SpecError, match="width = 4 there, and 8"):
        service.run("cornell", tmp_path / "store", tmp_path / "run", "paper", changes, log=str)
    assert not (tmp_path / "run").exists()


def test_inputs_that_the_weights_know_otherwise_are_said(begin: Callable[..., Path], tmp_path: Path) -> None:
    changes = {**NETWORK, "start_from": str(begin("first", steps=1)), "max_seconds": 0.01}
    for others, known in (({}, False), ({"points": 32, "least_specular": 0.04}, True)):
        said: list[str] = []
        with pytest.raises(IncompleteError):
            service.run(
                "cornell", tmp_path / "store", tmp_path / "run", "paper-dynamic", changes | others, log=said.append
            )
        told = any(line.endswith("points = 64, and not 32; least_specular = 0.0, and not 0.04") for line in said)
        assert told == any("its weights know" in line for line in said) == known


def test_a_filter_that_is_left_open_is_that_of_the_run_which_it_starts_from(begin: Callable[..., Path]) -> None:
    network = {**NETWORK, "architecture": "guided_denoise"}
    first = begin("first", network={**network, "filter": "own"})
    assert read_settings(begin("second", network=network, start_from=str(first))).network.filter == "own"
