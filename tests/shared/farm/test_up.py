"""What `photonfarm up` refuses before it begins, and what it says of how far it is."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples

from photonfarm.cli.show_watch import FarmTalk, progress_line
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.farm import up
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.status import StoreQueue
from photonfarm.farm.training import RunFolder
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.queue import Activity, QueueStatus
from photonfarm.store import Store


def test_further_passes_are_told_apart_from_samples(store: Store, tmp_path: Path) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=3, passes=2), shard_rows=4).scene_id)
    farm = up._Farm(scene, tmp_path, 10)
    assert farm.look() == up.FarmProgress((0, 6), (0, 0), 0, 10, "")
    assert progress_line(farm.look()) == "samples 0/6  steps 0/10"
    scene.plan(TopUp.of("+24", ["views=first:2"]))  # three passes of 8 samples per pixel each
    samples.commit(scene, 0, samples.outputs(scene, 0))
    assert (farm.look().samples, farm.look().passes) == ((4, 6), (0, 6))
    samples.commit(scene, 2, samples.outputs(scene, 2))
    assert (farm.look().samples, farm.look().passes) == ((4, 6), (4, 6))
    assert progress_line(farm.look()) == "samples 4/6  further passes 4/6  steps 0/10"


def test_what_workers_do_and_why_they_do_not_stands_in_the_line(store: Store, tmp_path: Path) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=6), shard_rows=4).scene_id)
    doing = {"ada": Activity("renders samples", 3, 4), "bob": Activity("loads the scene")}
    status = QueueStatus(1, 2, 2, {}, activities=doing)
    working = up._Farm(scene, tmp_path, 0, lambda: StoreQueue(status, [])).look()
    assert progress_line(working, 90.0) == (
        "samples 0/6 (+3 in hand), 90 s left  (ada renders samples 3/4; bob loads the scene)"
    )
    samples.commit(scene, 0, samples.outputs(scene, 0))
    seconds_later = up._Farm(scene, tmp_path, 0, lambda: StoreQueue(status, [])).look()
    assert (seconds_later.samples, seconds_later.in_hand) == ((4, 6), 2), "no more than are missing"
    full = replace(status, paused={"ada": "the disk is full"}, activities={})
    waiting = up._Farm(scene, tmp_path, 0, lambda: StoreQueue(full, [])).look()
    assert progress_line(waiting) == "samples 4/6  (worker ada takes no jobs: the disk is full)"


def test_the_log_of_another_run_is_not_counted_where_nothing_is_trained(store: Store, tmp_path: Path) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=3), shard_rows=4).scene_id)
    record = {"kind": "validation", "step": 7, "error": 0.5, "standard_error": 0.1, "held_out": 1}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(record) + "\n")
    assert up._Farm(scene, tmp_path, 0).look() == up.FarmProgress((0, 3), (0, 0), 0, 0, "")
    trained = up._Farm(scene, tmp_path, 10).look()
    assert (trained.step, trained.note) == (7, ", held-out error 0.50000 ± 0.10000 on 1 sample")


def test_a_run_that_has_more_steps_than_are_wanted_says_so(store: Store, tmp_path: Path) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=3), shard_rows=4).scene_id)
    (tmp_path / "metrics.jsonl").write_text(json.dumps({"kind": "end", "step": 2097, "reason": "steps"}) + "\n")
    (tmp_path / "settings.json").write_text('{"max_steps": 2000}')
    assert progress_line(up._Farm(scene, tmp_path, 2000).look()) == "samples 0/3  steps 2097 (2000 wanted)"
    assert RunFolder(tmp_path).look().line.endswith(": step 2097 (2000 wanted), ended (steps)")


def test_the_last_line_is_the_complete_one_also_where_a_process_fails(
    store: Store, redis_server: EmbeddedRedis, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=6), shard_rows=4).scene_id)
    (tmp_path / "trainer.log").write_text("no\n")
    trainer = subprocess.Popen([sys.executable, "-c", "raise SystemExit(8)"])
    worker = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    samples.commit_all(scene)
    trainer.wait()
    try:
        with pytest.raises(IncompleteError):
            up._watch({"worker": worker, "trainer": trainer}, up._Farm(scene, tmp_path, 0), redis_server, FarmTalk())
    finally:
        worker.communicate(b"\n")
    assert capsys.readouterr().err.split(maxsplit=2)[2] == "samples 6/6\n"


def test_what_is_in_hand_is_not_counted_again_at_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of what is in hand comes before or after its commit; counted twice it halves the time left."""
    now, lines = [0.0], list[str]()
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    talk = FarmTalk()
    monkeypatch.setattr(talk, "say", lines.append)
    found = up.FarmProgress((0, 100), (0, 0), 0, 0, "")
    with talk.progress(0) as show:
        for second in range(1, 41):  # a sample per second, in jobs of four
            now[0] = float(second)
            committed = second // 4 * 4
            in_hand = 4 if second % 4 == 0 else second % 4 if second % 4 > 1 else 0
            show(replace(found, samples=(committed, 100), in_hand=in_hand), False)
    (left,) = re.findall(r", (\d+) s left", lines[-1])
    assert 50 <= int(left) <= 70


def test_a_process_that_was_killed_is_told_apart_from_one_that_failed() -> None:
    assert (up._end(-9), up._end(7)) == ("was ended by SIGKILL", "ended with exit code 7")


@pytest.mark.parametrize("train_steps", [0, 10])
def test_a_spec_that_is_not_there_is_refused_before_anything_is_made(tmp_path: Path, train_steps: int) -> None:
    talk: Any = None  # nothing is said
    made = {"run": tmp_path / "run", "out": tmp_path / "out"}
    with pytest.raises(SpecError):
        up.run_farm(
            str(tmp_path / "none.toml"),
            tmp_path / "store",
            Request(modifications=3),
            talk,
            workers=1,
            train_steps=train_steps,
            hold_out=0.5,
            **made,
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", [{"reference_spp": 1 << 31}, {"reference_views": 1_000_000_000}])
def test_references_that_cannot_be_planned_are_refused_before_anything_is_made(
    tmp_path: Path, wrong: dict[str, int]
) -> None:
    talk: Any = None  # nothing is said
    made = {"run": tmp_path / "run", "out": tmp_path / "out"}
    with pytest.raises(SpecError):
        up.run_farm(
            "cornell",
            tmp_path / "store",
            Request(modifications=30),
            talk,
            workers=1,
            train_steps=10,
            hold_out=1 / 3,
            **{"reference_views": 1, **wrong},
            **made,
        )
    assert list(tmp_path.iterdir()) == []


class Quiet:
    """Says nothing."""

    def say(self, line: str) -> None:
        pass

    @contextmanager
    def progress(self, _: int) -> Iterator[Callable[[up.FarmProgress, bool], None]]:
        yield lambda *_: None


def test_a_refusal_does_not_promise_that_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = SpecError.exit_code
    monkeypatch.setattr(up, "command", lambda *_: [sys.executable, "-c", f"import sys; sys.exit({code})"])
    with pytest.raises(IncompleteError) as caught:
        up.run_farm(
            "cornell",
            tmp_path / "store",
            Request(modifications=2),
            Quiet(),
            workers=1,
            train_steps=0,
            hold_out=0.5,
            run=tmp_path / "run",
            out=tmp_path / "out",
        )
    assert str(caught.value).startswith(f"worker-1 ended with exit code {code}; ")
    assert "same command" not in str(caught.value)


def test_what_failed_first_is_told_also_if_the_preview_fails_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def command(verb: str, *_: str) -> list[str]:
        return [sys.executable, "-c", f"import sys; print('no {verb}'); sys.exit({6 if verb == 'work' else 4})"]

    monkeypatch.setattr(up, "command", command)
    with pytest.raises(IncompleteError) as caught:
        up.run_farm(
            "cornell",
            tmp_path / "store",
            Request(modifications=2),
            Quiet(),
            workers=1,
            train_steps=0,
            hold_out=0.5,
            run=tmp_path / "run",
            out=tmp_path / "out",
        )
    said = str(caught.value)
    assert said.startswith("worker-1 ended with exit code 6; ")
    assert "says: no work. What is rendered" in said
    assert "goes on from there. After that, photonfarm preview ended with exit code 4" in said
