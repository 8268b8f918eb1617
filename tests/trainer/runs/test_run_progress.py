"""What a trainer says of what it does, and the pictures that it leaves for those who watch."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from photonfarm.core.pictures import display
from photonfarm.farm.training import PROGRESS, VIEWS, RunFolder
from photonfarm.trainer.runs import progress as progress_module
from photonfarm.trainer.runs import run_folder
from photonfarm.trainer.runs.progress import RunProgress, follow_progress
from photonfarm.trainer.runs.run_folder import MOST, write_views
from photonfarm.trainer.training.loop import Hooks, train


def test_phase_and_time_left_follow_the_session() -> None:
    now = [0.0]
    progress = RunProgress(100, batch=4, clock=lambda: now[0])
    now[0] = 5.0
    assert progress.line() == "step 0/100: waits for samples for 5 s, 0 samples arrived"
    progress.phase("train")
    progress.note_draws(80, 24)
    now[0] = 25.0
    found = progress.look()
    assert (found["step"], found["phase"], found["samples"]) == (20, "trains", 24)
    assert found["left_s"] == pytest.approx(80 * 20 / 20)
    progress.phase("validate")
    now[0] += 0.5
    assert progress.look()["phase"] == "trains", "what is over soon is a part of training"
    now[0] += 5.0
    assert "validates for 6 s" in progress.line()


def test_a_line_comes_every_five_seconds_and_others_read_the_file_meanwhile(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_module, "FILE_S", 0.02)
    monkeypatch.setattr(progress_module, "LINE_S", 0.1)
    said: list[str] = []
    run.mkdir()
    progress = RunProgress(100, batch=1)
    with follow_progress(progress, run, said.append):
        progress.note_draws(30, 50)
        end = time.monotonic() + 10
        while len(said) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        assert (RunFolder(run).look().step, RunFolder(run).look().steps) == (30, 100)
    assert len(said) >= 2
    assert not (run / PROGRESS).exists()
    assert RunFolder(run).look().phase is None


def test_pictures_of_held_out_views_are_whole_name_their_rows_and_are_thinned_out(run: Path) -> None:
    images = np.random.default_rng(0).uniform(size=(6, 8, 16, 3)).astype(np.float32)
    for step in range(0, 100 * (MOST + 1), 100):
        write_views(run, "ab" * 16, step, (3, 5, 8, 13, 21, 34), images)
    files = sorted((run / VIEWS).iterdir())
    steps = [int(file.stem.removeprefix("step-")) for file in files]
    assert steps[0] == 0
    assert steps[-1] == 100 * MOST
    assert MOST / 2 <= len(files) <= MOST
    with Image.open(files[-1]) as picture:
        assert picture.text == {"scene": "ab" * 16, "rows": "3 5 8 13"}
        shown = np.asarray(picture)
    assert np.array_equal(shown, np.concatenate([display(image, 1.0) for image in images[:4]], axis=1))


def test_a_trained_run_leaves_pictures_of_each_validation(make_source, tiny, run: Path) -> None:
    source, written = make_source(24), []

    def show(step: int, rows: tuple[int, ...], targets: np.ndarray, predictions: np.ndarray) -> None:
        written.append((step, rows, targets.shape, predictions.shape))
        write_views(run, source.spec.scene_id, step, rows, predictions)

    train(source, tiny(), run, Hooks(on_images=show))
    log = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    validations = [record for record in log if record["kind"] == "validation"]
    assert [step for step, *_ in written] == [record["step"] for record in validations]
    for _, rows, targets, predictions in written:
        assert len(rows) == targets[0] == predictions[0] >= min(run_folder.SHOWN, validations[0]["held_out"])
    assert len(list((run / VIEWS).iterdir())) == len(written)
