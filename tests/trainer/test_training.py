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

from photonfarm.shared.errors import IncompleteError, SpecError, StoreError
from photonfarm.trainer import checkpoint, metrics_log, service
from photonfarm.trainer.figures import evaluate
from photonfarm.trainer.following import Growth
from photonfarm.trainer.loop import CHECKPOINT, METRICS, read_settings, stop_on_signals, train
from photonfarm.trainer.run_folder import held
from photonfarm.trainer.settings import NetworkSettings, small


class KilledError(Exception):
    """Stands for a kill between two checkpoints: nothing runs after it that would tidy up."""


def kill_at(step: int):
    def listen(record: dict[str, Any]) -> None:
        if record["kind"] == "validation" and record["step"] == step:
            raise KilledError

    return listen


def weights(run) -> dict[str, torch.Tensor]:
    return checkpoint.load(run / CHECKPOINT)["network"]


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(one[name], other[name]) for name in one)


def test_the_held_out_error_falls_fivefold_and_below_the_mean_colours(make_source, run) -> None:
    source = make_source(256, size=32, points=1024, noise=0.7)
    how = {"batch": 4, "epoch_samples": 50_000, "max_steps": 700, "validate_every": 700, "poll_seconds": 0.05}
    settings = small(network=NetworkSettings(width=8), **how)
    outcome = train(source, settings, run)
    found = evaluate(make_source(256, size=32, points=1024, noise=0.7), settings, run)
    assert outcome.last_error == pytest.approx(found.last.error.mean, rel=1e-5)
    assert found.first.error.mean > 5 * found.last.error.mean
    assert found.mean_colour.error.mean > 2 * found.last.error.mean
    assert found.last.error.count >= 16


def test_a_killed_run_goes_on_to_the_same_weights_to_the_bit(make_source, tiny, run, tmp_path) -> None:
    train(make_source(24), tiny(), run)
    broken = tmp_path / "broken"
    with pytest.raises(KilledError):
        train(make_source(24), tiny(), broken, listen=kill_at(10))
    assert checkpoint.load(broken / CHECKPOINT)["step"] == 8
    train(make_source(24), tiny(), broken)
    assert same(weights(run), weights(broken))
    steps = [[(r["kind"], r["step"]) for r in metrics_log.read(path / METRICS)] for path in (run, broken)]
    assert steps[0] == steps[1]


@pytest.mark.parametrize("per_look", [1, 2, 3, 6])
def test_a_run_that_grew_repeats_to_the_bit_from_its_growth_even_if_killed(
    make_source, tiny, run, tmp_path, per_look: int
) -> None:
    growing = {"replay_ratio": 1.0, "replay_buffer": 0, "minimum_samples": 8, "poll_seconds": 0.1 * per_look / 6}
    settings = tiny(max_steps=20, **growing)
    train(make_source(60, per_look=per_look), settings, run)
    state = checkpoint.load(run / CHECKPOINT)["following"]
    script = Growth(state["arrived"], [tuple(entry) for entry in state["growth"]])
    assert len(script.log) > 3, "rows arrived between steps"

    again = tmp_path / "again"
    with pytest.raises(KilledError):
        train(make_source(60), settings, again, script=script, listen=kill_at(10))
    train(make_source(60), settings, again, script=script)
    assert same(weights(run), weights(again))
    other = tmp_path / "other"
    train(make_source(60), settings, other)
    assert not same(weights(run), weights(other)), "another growth is another run"


def test_other_seeds_are_other_runs(make_source, tiny, run, tmp_path) -> None:
    train(make_source(24), tiny(), run)
    train(make_source(24), tiny(seed=1), tmp_path / "other")
    assert not same(weights(run), weights(tmp_path / "other"))


def test_a_store_that_is_empty_at_first_is_trained_on_as_it_grows(make_source, tiny, run) -> None:
    source = make_source(30, per_look=0)
    looks = 0
    release = source.refresh

    def refresh() -> Any:
        nonlocal looks
        looks += 1
        source._per_look = 0 if looks < 5 else 3
        return release()

    source.refresh = refresh
    outcome = train(source, tiny(replay_ratio=1.0, replay_buffer=0), run)
    records = metrics_log.read(run / METRICS)
    assert outcome.step == 12
    assert records[0]["kind"] == "validation"
    assert records[0]["step"] == 0
    assert records[0]["samples"] < records[-1]["samples"] == 30
    assert records[-1]["seconds"]["wait_data"] > 0.02


def test_draws_stay_below_the_replay_ratio_while_more_is_to_come(make_source, tiny, run) -> None:
    source = make_source(1000, per_look=24)
    source.planned = lambda: 2000
    settings = tiny(max_steps=1000, max_seconds=3.0, replay_ratio=0.5, replay_buffer=6, poll_seconds=0.5)
    outcome = train(source, settings, run)
    following = checkpoint.load(run / CHECKPOINT)["following"]
    arrived = len(following["sampler"]["rows"])
    assert outcome.reason == "seconds"
    assert 0.5 * arrived + 6 - 3 < following["drawn"] * 3 <= 0.5 * arrived + 6


def test_validation_comes_first_then_regularly_and_at_the_end(make_source, tiny, run) -> None:
    outcome = train(make_source(24), tiny(), run)
    found = [r for r in metrics_log.read(run / METRICS) if r["kind"] == "validation"]
    assert [r["step"] for r in found] == [0, 5, 10, 12]
    assert outcome.last_error == found[-1]["error"]
    assert all(r["noise_floor"] > 0 and r["standard_error"] > 0 for r in found)


def test_held_out_rows_are_never_trained_on(make_source, tiny, run) -> None:
    train(make_source(60, views=3), tiny(), run)
    following = checkpoint.load(run / CHECKPOINT)["following"]
    assert len(following["held_out"]) >= 3
    assert not set(following["held_out"]) & set(following["sampler"]["rows"])
    assert set(following["held_out"]) | set(following["sampler"]["rows"]) == set(range(60))


@pytest.mark.parametrize("name", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_a_checkpoint_and_ends_the_run(make_source, tiny, run, name: signal.Signals) -> None:
    def listen(record: dict[str, Any]) -> None:
        if record["step"] == 5:
            os.kill(os.getpid(), name)

    with stop_on_signals() as stop:
        outcome = train(make_source(24), tiny(), run, stop=stop, listen=listen)
    assert outcome.reason == "stopped"
    assert checkpoint.load(run / CHECKPOINT)["step"] == outcome.step < 12


def test_waiting_for_a_scene_ends_when_it_is_told_to(make_source, tiny, run) -> None:
    source, stop = make_source(3), threading.Event()
    source.ready = lambda: False
    assert train(source, tiny(max_seconds=0.05), run).reason == "seconds"
    stop.set()
    assert train(source, tiny(), run, stop=stop).reason == "stopped"


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_checkpoint(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=4), run)
    before = weights(run)
    source = make_source(24)
    honest = source.read

    def read(row: int) -> Any:
        sample = honest(row)
        sample.radiance[0, 3, 3, 0] = np.nan
        return sample

    source.read = read
    with pytest.raises(IncompleteError, match="step 4: the loss is nan on rows"):
        train(source, tiny(), run)
    assert same(before, weights(run))


@pytest.mark.parametrize("change", [{"seed": 2}, {"batch": 2}, {"network": NetworkSettings(width=5)}])
def test_a_run_is_not_continued_as_another_one(make_source, tiny, run, change: dict[str, Any]) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    with pytest.raises(SpecError, match=r"checkpoint\.pt: was trained with .* use another run directory"):
        train(make_source(24), tiny(**change), run)
    assert read_settings(run) == tiny(max_steps=2)


def test_a_hold_out_that_leaves_nothing_to_validate_on_is_refused(make_source, tiny, run) -> None:
    with pytest.raises(SpecError, match="hold_out = 1e-06: of the 8 samples planned none is held out"):
        train(make_source(8), tiny(hold_out=1e-6), run)


def test_a_hold_out_that_leaves_nothing_to_train_on_is_refused(make_source, tiny, run) -> None:
    with pytest.raises(SpecError, match=r"hold_out = 0.999999: of the 8 samples planned all are held out"):
        train(make_source(8), tiny(hold_out=0.999999), run)


def test_time_that_is_up_before_anything_is_held_out_leaves_a_checkpoint(make_source, tiny, run) -> None:
    outcome = train(make_source(8, per_look=0), tiny(max_seconds=0.1), run)
    assert (outcome.reason, outcome.last_error) == ("seconds", None)
    assert checkpoint.load(run / CHECKPOINT)["step"] == 0


def test_a_run_has_one_trainer_at_a_time(make_source, tiny, run) -> None:
    with held(run), pytest.raises(StoreError, match="another trainer is at work on this run"):
        train(make_source(24), tiny(), run)
    assert train(make_source(24), tiny(max_steps=1), run).step == 1


@pytest.mark.parametrize("device", ["foo", "meta", "cuda:99"])
def test_a_device_that_is_not_there_is_refused(make_source, tiny, run, device: str) -> None:
    with pytest.raises(SpecError, match=f"device = '{device}'"):
        train(make_source(24), tiny(device=device), run)


def test_who_reads_the_log_while_it_is_cut_has_it_whole(tmp_path) -> None:
    path = tmp_path / METRICS
    log = metrics_log.MetricsLog(path)
    for step in (1, 2, 3):
        log.write("train", step=step)
    with path.open() as reader:
        log.cut(2)
        log.write("train", step=4)
        assert [json.loads(line)["step"] for line in reader] == [1, 2, 3]
    assert [record["step"] for record in metrics_log.read(path)] == [1, 2, 4]


def test_a_full_disk_is_named(tmp_path) -> None:
    for name in (METRICS, "checkpoint.partial"):
        (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(StoreError, match="cannot write the log: No space left"):
        metrics_log.MetricsLog(tmp_path / METRICS).write("train", step=1)
    with pytest.raises(StoreError, match="cannot write the checkpoint: No space left"):
        checkpoint.save(tmp_path / CHECKPOINT, {})


def test_a_run_folder_that_is_a_file_is_named(make_source, tiny, run) -> None:
    run.write_text("")
    with pytest.raises(StoreError, match="cannot keep a training run here"):
        train(make_source(24), tiny(), run)


def test_the_service_waits_for_a_scene_no_longer_than_it_may(run, tmp_path, capsys) -> None:
    began = time.monotonic()
    service.run(None, tmp_path / "store", run, "small", {"max_seconds": 0.3})
    assert time.monotonic() - began < 5
    assert "no scene to train on has come" in capsys.readouterr().err


def test_the_rate_falls_by_one_percent_with_every_epoch_of_samples(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=50, batch=2, epoch_samples=20), run)
    (record,) = [r for r in metrics_log.read(run / METRICS) if r["kind"] == "train"]
    assert record["rate"] == pytest.approx(5e-4 * 0.99**4)  # steps 40…49 draw samples 80…99: epoch 4


def test_a_damaged_checkpoint_is_refused_and_left_as_it_is(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    damaged = (run / CHECKPOINT).read_bytes()[:-2000]
    (run / CHECKPOINT).write_bytes(damaged)
    with pytest.raises(StoreError, match="is not a readable checkpoint"):
        train(make_source(24), tiny(), run)
    assert (run / CHECKPOINT).read_bytes() == damaged


@pytest.mark.parametrize(
    "content", [b"", b"garbage", b"\x80\x02}q\x00.", bytes(range(256)) * 9, b"PK\x03\x04" + bytes(99)]
)
def test_bytes_that_are_no_checkpoint_are_refused(tmp_path, content: bytes) -> None:
    (tmp_path / CHECKPOINT).write_bytes(content)
    with pytest.raises(StoreError, match=r"checkpoint\.pt: (is not a readable checkpoint|has format None)"):
        checkpoint.load(tmp_path / CHECKPOINT)
