"""What TensorBoard reads of a run, by its own reader."""

import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.trainer.runs import run_folder
from photonfarm.trainer.runs import tensorboard as boards
from photonfarm.trainer.runs.run_folder import METRICS
from photonfarm.trainer.training import loop
from photonfarm.trainer.training.loop import Hooks, train

pytest.importorskip("tensorboard", reason="TensorBoard is an optional extra")


def accumulated(run: Path) -> Any:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run / boards.FOLDER), size_guidance={"images": 0, "scalars": 0})
    events.Reload()
    return events


def trained(source: Any, settings: Any, run: Path, then: Callable[[dict[str, Any]], None] = lambda _: None) -> None:
    with boards.open_event_files(run) as board:
        train(
            source,
            settings,
            run,
            Hooks(
                on_record=lambda record: [board.record(record), then(record)],
                on_images=lambda step, _rows, *shown: board.pictures(step, *shown),
            ),
        )


def test_a_run_shows_its_records_and_pictures(make_source, tiny, run, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    monkeypatch.setattr(loop, "LOG_EVERY", 10)
    trained(make_source(24), tiny(), run)
    events, records = accumulated(run), run_folder.read_log(run / METRICS)
    told = [r for r in records if r["kind"] == "validation"]
    found = events.Scalars("error/held out")
    assert [(e.step, e.value) for e in found] == [(r["step"], pytest.approx(r["error"])) for r in told]
    (loss,) = [r for r in records if r["kind"] == "train"]
    assert [(e.step, e.value) for e in events.Scalars("loss/training")] == [(10, pytest.approx(loss["loss"]))]
    names = {"optimiser/rate", "waits/samples", "waits/reading", "samples/arrived", "samples/drawn"}
    assert names <= set(events.Tags()["scalars"])
    pictures = events.Images("held out/target above prediction")
    assert [picture.step for picture in pictures] == [r["step"] for r in told]
    shown = np.asarray(Image.open(io.BytesIO(pictures[-1].encoded_image_string)))
    assert shown.shape == (32, 4 * 16, 3)


def test_what_was_shown_after_the_checkpoint_is_taken_back_when_the_run_goes_on(make_source, tiny, run) -> None:
    def broken(record: dict[str, Any]) -> None:
        if record["step"] == 10:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        trained(make_source(24), tiny(), run, broken)
    time.sleep(1)  # files are read in the order of their names, which begin with the second
    trained(make_source(24), tiny(), run)
    assert [e.step for e in accumulated(run).Scalars("error/held out")] == [0, 5, 10, 12]


def test_without_tensorboard_nothing_is_written(run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boards, "find_spec", lambda _: None)
    with boards.open_event_files(run) as board:
        assert board is None
    assert not run.exists()
