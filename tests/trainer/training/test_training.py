"""Training runs on the analytic scene: learning, pace, interruption, exact resume."""

import json
import os
import signal
import threading
import time
from typing import Any

import numpy as np
import pytest
import torch
from held_out_errors import held_out_errors

from photonfarm.core.errors import IncompleteError
from photonfarm.core.processes import stop_on_signals
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.scene.spec_loading import load_spec
from photonfarm.trainer import service
from photonfarm.trainer.cli import show
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.devices import describe_device, usable_device
from photonfarm.trainer.runs.run_folder import CHECKPOINT, METRICS
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.learner import DivergedError
from photonfarm.trainer.training.loop import Hooks, train


def weights(run) -> dict[str, torch.Tensor]:
    return checkpoint.load(run / CHECKPOINT)["network"]


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(one[name], other[name]) for name in one)


def test_the_held_out_error_falls_fivefold_and_below_the_mean_colours(make_source, run) -> None:
    how = {"batch": 2, "learning_rate": 3e-3, "schedule": "cosine", "average": 0.99, "hold_out": 1 / 8}
    settings = TrainSettings(network=NetworkSettings(width=8), max_steps=250, validate_every=250, **how)
    outcome = train(make_source(96, noise=0.4), settings, run)
    found = held_out_errors(lambda: make_source(96, noise=0.4), run)
    assert outcome.last_error == pytest.approx(found.last, rel=1e-5)
    assert found.first > 5 * found.last
    assert found.mean_colour > 1.2 * found.last
    assert found.configurations >= 8


def test_other_seeds_are_other_runs(make_source, tiny, run, tmp_path) -> None:
    train(make_source(24), tiny(), run)
    train(make_source(24), tiny(seed=1), tmp_path / "other")
    assert not same(weights(run), weights(tmp_path / "other"))


def test_a_store_that_is_empty_at_first_is_trained_on_as_it_grows(make_source, tiny, run) -> None:
    """Nothing arrives until training has begun, and then for 0.1 s, which it can only wait through."""
    source, begun = make_source(30, per_look=0), threading.Event()
    release = source.refresh

    def refresh() -> Any:
        if begun.is_set() and not source._per_look:
            time.sleep(0.1)
            source._per_look = 3
        return release()

    source.refresh = refresh
    settings = tiny(replay_ratio=1.0, replay_buffer=0)
    outcome = train(source, settings, run, Hooks(on_draws=lambda *_: begun.set()))
    records = run_folder.read_log(run / METRICS)
    assert outcome.step == 12
    assert records[0]["kind"] == "validation"
    assert records[0]["step"] == 0
    assert records[0]["samples"] < records[-1]["samples"] == 30
    assert records[0]["seconds"]["wait_data"] > 0.08
    assert records[0]["waits"]["samples"] == pytest.approx(share_of("wait_data", records[0]["seconds"]), abs=0.05)


def share_of(kind: str, seconds: dict[str, float]) -> float:
    return seconds[kind] / sum(seconds.values())


def test_draws_come_up_to_the_replay_ratio_and_no_further_while_more_is_to_come(make_scarce, tiny, run) -> None:
    source, stop = make_scarce(1000, lot=24, patience=40), threading.Event()
    release = source.refresh

    def refresh() -> Any:
        if len(source.stalls) == 4:
            stop.set()
        return release()

    source.refresh = refresh
    settings = tiny(max_steps=1000, replay_ratio=0.5, replay_buffer=6, poll_seconds=0.02, validate_every=1000)
    assert train(source, settings, run, Hooks(stop=stop, on_draws=source.count)).reason == "stopped"
    for lots, draws in enumerate(source.stalls[1:4], 1):
        training = rows_held_out(source, range(24 * lots), settings.hold_out).count(False)
        assert 0.5 * training + 6 - 3 < draws <= 0.5 * training + 6


def test_validation_comes_first_then_regularly_and_at_the_end(make_source, tiny, run) -> None:
    outcome = train(make_source(24), tiny(), run)
    found = [r for r in run_folder.read_log(run / METRICS) if r["kind"] == "validation"]
    assert [r["step"] for r in found] == [0, 5, 10, 12]
    assert outcome.last_error == found[-1]["error"]
    assert all(r["noise_floor"] > 0 and r["standard_error"] > 0 for r in found)


def test_held_out_rows_are_never_trained_on(make_source, tiny, run) -> None:
    train(make_source(60, views=3), tiny(), run)
    following = checkpoint.load(run / CHECKPOINT)["following"]
    held_out, trained_on = set(following["held_out"].tolist()), set(following["sampler"]["rows"].tolist())
    assert len(held_out) >= 3
    assert not held_out & trained_on
    assert held_out | trained_on == set(range(60))


@pytest.mark.parametrize("name", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_a_checkpoint_and_ends_the_run(make_source, tiny, run, name: signal.Signals) -> None:
    def listen(record: dict[str, Any]) -> None:
        if record["step"] == 5:
            os.kill(os.getpid(), name)

    with stop_on_signals() as stop:
        outcome = train(make_source(24), tiny(), run, Hooks(stop=stop, on_record=listen))
    assert outcome.reason == "stopped"
    assert checkpoint.load(run / CHECKPOINT)["step"] == outcome.step < 12


def test_waiting_for_a_scene_ends_when_it_is_told_to(make_source, tiny, run) -> None:
    source, stop = make_source(3), threading.Event()
    source.ready = lambda: False
    assert train(source, tiny(max_seconds=0.05), run).reason == "seconds"
    stop.set()
    assert train(source, tiny(), run, Hooks(stop=stop)).reason == "stopped"


def test_a_loss_that_is_not_finite_ends_a_run_that_is_not_to_recover_and_keeps_the_checkpoint(
    make_source, tiny, run
) -> None:
    train(make_source(24), tiny(max_steps=4, recover=False), run)
    before = weights(run)
    source = make_source(24)
    honest = source.read

    def read(row: int) -> Any:
        sample = honest(row)
        sample.radiance[0, 3, 3, 0] = np.nan
        return sample

    source.read = read
    with pytest.raises(DivergedError) as diverged:
        train(source, tiny(recover=False), run)
    assert diverged.value.exit_code == 8, "apart from work that a new start would finish"
    assert same(before, weights(run))


def test_what_a_run_logged_up_to_its_end_stays_where_it_goes_on(make_source, tiny, run) -> None:
    """A last validation stays too, one that is due at no other step; and all does where nothing is left to do."""
    train(make_source(24), tiny(), run)
    ended = run_folder.read_log(run / METRICS)
    assert [(r["kind"], r["step"]) for r in ended[-2:]] == [("validation", 12), ("end", 12)]
    train(make_source(24), tiny(max_steps=15), run)
    longer = run_folder.read_log(run / METRICS)
    assert longer[: len(ended)] == ended
    told = [(r["kind"], r["step"]) for r in longer[len(ended) :]]
    assert told == [("changes", 12), ("validation", 15), ("end", 15)]
    train(make_source(24), tiny(max_steps=15), run)
    assert run_folder.read_log(run / METRICS) == longer


def test_what_may_change_is_told_and_logged_where_a_run_goes_on(make_source, tiny, run, capsys) -> None:
    train(make_source(24), tiny(max_steps=5), run, Hooks(on_record=show.print_record))
    train(make_source(24), tiny(max_steps=7, learning_rate=1e-3), run, Hooks(on_record=show.print_record))
    changed = [record for record in run_folder.read_log(run / METRICS) if record["kind"] == "changes"]
    wanted = {"learning_rate": [5e-4, 1e-3], "max_steps": [5, 7]}
    assert changed == [{"kind": "changes", "step": 5, "changes": wanted}]
    said = "settings changed at step 5: learning_rate = 0.001 (before 0.0005), max_steps = 7 (before 5)"
    assert capsys.readouterr().err.splitlines().count(said) == 1
    train(make_source(24), tiny(max_steps=7, learning_rate=1e-3), run)
    assert [r["kind"] for r in run_folder.read_log(run / METRICS)].count("changes") == 1


def test_who_reads_the_log_while_it_is_cut_has_it_whole(tmp_path) -> None:
    path = tmp_path / METRICS
    log = run_folder.MetricsLog(path)
    for step in (1, 2, 3):
        log.write("train", step=step)
    with path.open() as reader:
        log.cut(2)
        log.write("train", step=4)
        assert [json.loads(line)["step"] for line in reader] == [1, 2, 3]
    assert [record["step"] for record in run_folder.read_log(path)] == [1, 2, 4]


def test_the_service_waits_for_a_scene_no_longer_than_it_may(run, tmp_path) -> None:
    told, began = [], time.monotonic()
    asked = (None, tmp_path / "store", run, "small", {"max_seconds": 0.3})
    with pytest.raises(IncompleteError, match=r"no scene .* in 0\.3 s; nothing was trained"):
        service.run(*asked, log=told.append, on_record=told.append)
    assert time.monotonic() - began < 5
    assert told[0] == f"training on {describe_device(usable_device('auto'))}"


def test_a_service_that_is_stopped_while_it_waits_for_a_scene_has_done_what_it_was_asked_for(
    run, tmp_path, monkeypatch
) -> None:
    def signalled(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    told = []
    monkeypatch.setattr(service, "_find_only_scene", signalled)
    service.run(None, tmp_path / "store", run, "small", {}, log=told.append, on_record=told.append)
    assert any("no scene" in line for line in told)
    with pytest.raises(IncompleteError):  # for whom "done" would mean that nobody need start it again
        service.run(None, tmp_path / "store", run, "small", {}, until_complete=True, log=told.append)


def test_the_service_says_which_scene_it_waits_for(scene, run) -> None:
    store, said = scene.folder.parent.parent, []
    with pytest.raises(IncompleteError, match="nothing was trained"):
        service.run("cornell", store, run, "small", {"max_seconds": 0.3}, log=said.append, on_record=said.append)
    assert any(f"waiting for scene {load_spec('cornell').scene_id}" in str(line) for line in said)
