"""The waits of a run: how its time is spent, as whoever waits for it is told."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.trainer.cli import show
from photonfarm.trainer.runs import checkpoint, run_folder
from photonfarm.trainer.runs.progress import Stopwatch, divide_by_used, find_bottleneck, format_waits, share_waits
from photonfarm.trainer.runs.run_folder import METRICS
from photonfarm.trainer.training.loop import Hooks, train

BEFORE = {"train": 10.0, "validate": 5.0, "wait_data": 100.0, "wait_read": 1.0}


@pytest.mark.parametrize(
    ("spent", "slow"),
    [
        ({"train": 9.0, "wait_data": 0.4}, "training"),
        ({"train": 4.0, "wait_data": 5.0, "wait_read": 1.0}, "rendering"),
        ({"train": 4.0, "wait_data": 1.0, "wait_read": 5.0}, "reading"),
        ({"train": 5.0, "wait_data": 4.0, "wait_read": 1.0}, "training"),
    ],
)
def test_what_most_of_the_time_since_goes_to_is_the_bottleneck(spent: dict[str, float], slow: str) -> None:
    now = {name: value + spent.get(name, 0.0) for name, value in BEFORE.items()}
    shares = share_waits(now, BEFORE)
    assert shares["samples"] == pytest.approx(spent.get("wait_data", 0) / sum(spent.values()), abs=1e-4)
    assert shares["reading"] == pytest.approx(spent.get("wait_read", 0) / sum(spent.values()), abs=1e-4)
    assert find_bottleneck(shares) == slow
    assert f"{slow} is the bottleneck" in format_waits(shares, 1.0)


def test_at_any_moment_time_goes_to_one_kind_and_all_kinds_together_are_the_wall_time() -> None:
    now = 100.0
    watch = Stopwatch(lambda: now, "wait_data", 2.0, None)
    now += 1
    watch.turn("start")
    now += 3
    watch.turn("other")
    with watch.on("validate"):
        now += 5
        with watch.on("wait_data"):
            now += 0.5
        now += 1
    now += 0.25
    watch.add({"train": 7.0, "wait_data": 1.0})
    found = {kind: value for kind, value in watch.seconds.items() if value}
    assert found == {"wait_data": 4.5, "start": 3.0, "validate": 6.0, "other": 0.25, "train": 7.0}
    assert sum(watch.seconds.values()) == now - 100 + 2 + 8


@pytest.mark.parametrize(("samples", "draws", "each"), [(100, 0, 100.0), (100, 40, 2.5), (100, 4000, 1.0), (0, 0, 0)])
def test_samples_for_each_used_are_what_ahead_is_compared_with(samples: int, draws: int, each: float) -> None:
    assert divide_by_used(samples, draws) == each


def test_a_run_that_waits_for_rendering_says_so_with_each_validation(
    make_source, make_scarce, tiny, run, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twelve samples come whenever it has waited through 30 looks, 0.6 s, and suffice for three steps."""
    train(make_source(24), tiny(max_steps=1), tmp_path / "before")  # a process' first run takes as long to begin
    source = make_scarce(60, lot=12, patience=30)
    scarce = tiny(max_steps=10, replay_ratio=1.0, replay_buffer=0, poll_seconds=0.02)
    train(source, scarce, run, Hooks(on_record=show.print_record, on_draws=source.count))
    records = run_folder.read_log(run / METRICS)
    told = [r for r in records if r["kind"] == "validation"]
    waited = [r["seconds"]["wait_data"] for r in told if r["step"] % 5 == 0]
    assert min(np.diff([0, *waited])) > 0.4
    assert all(r["samples_per_used"] >= 1 for r in records if r["draws"])
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(told)
    for line, record in zip(lines, told, strict=True):
        assert f"{find_bottleneck(record['waits'])} is the bottleneck" in line
        assert f"waited {record['waits']['samples']:.1%} of the time for samples" in line
    assert "samples there for each used (--ahead)" in lines[-1]


def slowed(plain: Callable[..., Any], seconds: float) -> Callable[..., Any]:
    def slow(*given: Any) -> Any:
        time.sleep(seconds)
        return plain(*given)

    return slow


def test_a_run_that_waits_for_reading_says_so(make_source, tiny, run) -> None:
    source: Any = make_source(24)
    source.read_samples = slowed(source.read_samples, 0.3)
    train(source, tiny(validate_every=100), run)
    last = run_folder.read_log(run / METRICS)[-1]
    assert find_bottleneck(share_waits(last["seconds"], {})) == "reading"


def test_what_is_no_training_is_counted_as_what_it_is_and_not_as_waiting(
    make_source, tiny, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Building takes 0.3 s, each of three checkpoints 0.2 s, and each of four records before the last 0.1 s."""
    source: Any = make_source(24)
    source.base = slowed(source.base, 0.3)
    monkeypatch.setattr(checkpoint, "save", slowed(checkpoint.save, 0.2))
    began = time.monotonic()
    train(source, tiny(), run, Hooks(on_record=slowed(lambda _: None, 0.1)))
    wall_s = time.monotonic() - began
    seconds = run_folder.read_log(run / METRICS)[-1]["seconds"]
    assert seconds["start"] >= 0.3 + 0.2, "the weights at the beginning are saved as well"
    assert seconds["save"] >= 3 * 0.2
    assert seconds["other"] >= 4 * 0.1
    assert seconds["wait_data"] < 0.5
    assert wall_s - 0.5 < sum(seconds.values()) < wall_s, "the last record itself is written after they are taken"


def test_time_that_goes_to_checkpoints_ends_a_run_too(make_source, tiny, run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "save", slowed(checkpoint.save, 0.2))
    outcome = train(make_source(24), tiny(max_steps=1000, max_seconds=1.0, checkpoint_every=1), run)
    assert (outcome.reason, outcome.step <= 5) == ("seconds", True)
