"""What a training run refuses, and what it says: other settings, other versions, damaged files, a folder in use."""

import json
import re
import shutil
from typing import Any

import pytest

from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.trainer import service
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.run_folder import CHECKPOINT, GOOD, INITIAL, METRICS, lock_run, read_settings
from photonfarm.trainer.runs.settings import EARLIER
from photonfarm.trainer.training.loop import train


def test_a_run_is_not_continued_as_another_one(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    changes: list[tuple[dict[str, Any], str]] = [
        ({"seed": 2}, "seed = 0, and 2"),
        ({"batch": 2}, "batch = 3, and 2"),
        ({"loss": "relative"}, "loss = 'linear', and 'relative'"),
        ({"optimiser": "rmsprop"}, "optimiser = 'adam', and 'rmsprop'"),
        ({"hold_out": 0.5}, r"hold_out = 0\.25, and 0\.5"),
        ({"network": {"width": 4, "demodulation": 0.5}}, r"with demodulation = None, and 0\.5"),
        ({"network": {"width": 5}, "loss": "relative", "max_steps": 3}, r"with width = 4, and 5.*loss = 'linear'"),
    ]
    for change, found in changes:
        with pytest.raises(SpecError, match=found):
            train(make_source(24), tiny(**change), run)
    assert read_settings(run) == tiny(max_steps=2)


@pytest.mark.parametrize("line", ["garbage", "[1]", '{"kind": "train"}'])
def test_a_log_that_holds_something_else_is_named(make_source, tiny, run, line: str) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    with (run / METRICS).open("a") as file:
        file.write(f"{line}\n")
    with pytest.raises(StoreError):
        run_folder.read_log(run / METRICS)
    with pytest.raises(StoreError, match="remove that line"):
        train(make_source(24), tiny(max_steps=3), run)
    assert checkpoint.load(run / CHECKPOINT)["step"] == 2


def test_weights_alone_are_no_checkpoint_to_go_on_from(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    shutil.copy(run / INITIAL, run / CHECKPOINT)
    with pytest.raises(StoreError):
        train(make_source(24), tiny(max_steps=3), run)


def test_a_trainer_that_is_refused_leaves_the_sign_of_life_of_the_one_at_work(run) -> None:
    with service._give_sign_of_life(run), lock_run(run):
        with service._give_sign_of_life(run):
            pass
        service.check(run)
    with service._give_sign_of_life(run):
        pass
    with pytest.raises(IncompleteError):
        service.check(run)


def test_a_folder_is_no_run_without_settings_that_are_those_of_one(run) -> None:
    with pytest.raises(StoreError):
        read_settings(run)
    run.mkdir()
    with pytest.raises(StoreError):
        read_settings(run)
    for text, named in (("{", r"settings\.json"), ('{"network": {"widht": 8}, "batch": 0}', "width.*; batch = 0")):
        (run / "settings.json").write_text(text)
        with pytest.raises(StoreError, match=named):
            read_settings(run)


def test_a_run_of_other_settings_than_its_checkpoints_is_refused(make_source, tiny, run) -> None:
    """A run of a version that lacked some settings is refused too: they would otherwise take today's values."""
    train(make_source(24), tiny(max_steps=1), run)
    written = json.loads((run / "settings.json").read_text())
    older = {**written, "network": {k: v for k, v in written["network"].items() if k not in ("octaves", "maxima")}}
    (run / "settings.json").write_text(json.dumps(older))
    with pytest.raises(SpecError, match="octaves, maxima"):
        TrainedRun.load(run)
    (run / "settings.json").write_text(json.dumps({**written, "network": {**written["network"], "octaves": 1}}))
    with pytest.raises(SpecError):
        TrainedRun.load(run)
    (run / "settings.json").write_text(json.dumps(written))
    (run / CHECKPOINT).unlink()
    with pytest.raises(StoreError):
        TrainedRun.load(run)


def test_a_checkpoint_of_another_versions_network_is_refused_as_that(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=1), run)
    state = checkpoint.load(run / CHECKPOINT)
    del state["settings"]["network"]["octaves"]
    checkpoint.save(run / CHECKPOINT, state)
    with pytest.raises(SpecError, match="octaves"):
        train(make_source(24), tiny(max_steps=2), run)


def test_a_run_of_before_there_was_a_setting_is_what_it_was(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=1), run)
    written, state = json.loads((run / "settings.json").read_text()), checkpoint.load(run / CHECKPOINT)
    for network in (written["network"], state["settings"]["network"]):
        assert {key: network.pop(key) for key in EARLIER} == EARLIER
    (run / "settings.json").write_text(json.dumps(written))
    checkpoint.save(run / CHECKPOINT, state)
    assert TrainedRun.load(run).settings == tiny(max_steps=1)
    with pytest.raises(SpecError, match=r"least_specular = 0\.0, and 0\.04"):
        train(make_source(24), tiny(network={"width": 4, "least_specular": 0.04}), run)
    assert train(make_source(24), tiny(max_steps=2), run).step == 2


@pytest.mark.parametrize("hold_out", [1e-06, 0.999999], ids=["nothing to validate on", "nothing to train on"])
def test_a_hold_out_that_leaves_one_side_empty_is_refused(make_source, tiny, run, hold_out: float) -> None:
    with pytest.raises(SpecError, match=f"hold_out = {hold_out}") as refused:
        train(make_source(8), tiny(hold_out=hold_out), run)
    (works,) = re.findall(r"hold_out = (\S+) holds out one", str(refused.value))
    assert train(make_source(8), tiny(hold_out=float(works), max_steps=1), run.with_name("other")).step == 1


def test_a_run_has_one_trainer_at_a_time(make_source, tiny, run) -> None:
    with lock_run(run), pytest.raises(StoreError):
        train(make_source(24), tiny(), run)
    assert train(make_source(24), tiny(max_steps=1), run).step == 1


def test_a_full_disk_is_a_store_error(tmp_path) -> None:
    for name in (METRICS, "checkpoint.partial"):
        (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(StoreError):
        run_folder.MetricsLog(tmp_path / METRICS).write("train", step=1)
    with pytest.raises(StoreError):
        checkpoint.save(tmp_path / CHECKPOINT, {})


def test_a_run_folder_that_is_a_file_is_a_store_error(make_source, tiny, run) -> None:
    run.write_text("")
    with pytest.raises(StoreError):
        train(make_source(24), tiny(), run)


def test_a_damaged_checkpoint_is_refused_and_left_as_it_is(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    damaged = (run / CHECKPOINT).read_bytes()[:-2000]
    (run / CHECKPOINT).write_bytes(damaged)
    with pytest.raises(StoreError):
        train(make_source(24), tiny(), run)
    assert (run / CHECKPOINT).read_bytes() == damaged


def test_a_checkpoint_whose_numbers_are_not_those_written_is_refused(make_source, tiny, run) -> None:
    train(make_source(24), tiny(max_steps=2), run)
    whole = bytearray((run / CHECKPOINT).read_bytes())
    whole[-400] ^= 1
    (run / CHECKPOINT).write_bytes(whole)
    for use in (lambda: train(make_source(24), tiny(), run), lambda: TrainedRun.load(run)):
        with pytest.raises(StoreError, match="do not match its checksum"):
            use()


def test_a_damaged_checkpoint_offers_the_good_one_beside_it_from_which_the_run_goes_on(make_source, tiny, run) -> None:
    settings = {"validate_every": 2, "checkpoint_every": 1}
    train(make_source(24), tiny(max_steps=3, **settings), run)
    step = checkpoint.load(run / GOOD)["step"]
    (run / CHECKPOINT).write_bytes((run / CHECKPOINT).read_bytes()[:-2000])
    with pytest.raises(StoreError, match=f"of step {step}: `mv {run / GOOD} {run / CHECKPOINT}`"):
        train(make_source(24), tiny(max_steps=5, **settings), run)
    (run / GOOD).replace(run / CHECKPOINT)
    assert train(make_source(24), tiny(max_steps=5, **settings), run).step == 5
    for name in (CHECKPOINT, GOOD):
        (run / name).write_bytes((run / name).read_bytes()[:-2000])
    with pytest.raises(StoreError, match="remove it"):
        train(make_source(24), tiny(max_steps=5), run)


def test_a_checkpoint_of_an_older_format_is_named_as_that(make_source, tiny, run, monkeypatch) -> None:
    with monkeypatch.context() as older:
        older.setattr(checkpoint, "FORMAT", 2)
        train(make_source(24), tiny(max_steps=2), run)
    with pytest.raises(StoreError, match="format 2"):
        checkpoint.load(run / CHECKPOINT)


def test_another_scene_than_that_of_the_run_is_refused_before_it_is_waited_for(
    make_source, tiny, run, tmp_path
) -> None:
    train(make_source(24), tiny(max_steps=1), run)
    with pytest.raises(SpecError, match=make_source(1).spec.scene_id):
        service.run("cornell", tmp_path / "store", run, "small", {}, log=print, on_record=print)


def test_a_batch_that_no_memory_holds_is_refused(make_source, tiny, run) -> None:
    with pytest.raises(SpecError):
        train(make_source(24), tiny(batch=10**12), run)


@pytest.mark.parametrize(
    "content", [b"", b"garbage", b"\x80\x02}q\x00.", bytes(range(256)) * 9, b"PK\x03\x04" + bytes(99)]
)
def test_bytes_that_are_no_checkpoint_are_refused(tmp_path, content: bytes) -> None:
    (tmp_path / CHECKPOINT).write_bytes(content)
    with pytest.raises(StoreError):
        checkpoint.load(tmp_path / CHECKPOINT)
