"""What `photonfarm up` refuses before it begins, and what it says where a part of it fails."""

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples

from photonfarm.cli.show_farm import follow_up
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.farm import up
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.request import Request
from photonfarm.store import Store


def run_farm(folder: Path, spec: str = "cornell", **settings: Any) -> None:
    """`up` of two configurations with a worker, which says nothing."""
    given = {"workers": 1, "train_steps": 0, "hold_out": 0.5, "run": folder / "run", "out": folder / "out"} | settings
    up.run_farm(
        spec,
        folder / "store",
        Request(modifications=2),
        lambda _: None,
        nullcontext(lambda *_: None),
        web=False,
        **given,
    )


@pytest.mark.parametrize(
    ("spec", "settings"),
    [
        ("none.toml", {}),
        ("none.toml", {"train_steps": 10}),
        ("cornell", {"train_steps": 10, "reference_views": 1, "reference_spp": 1 << 31}),
        ("cornell", {"train_steps": 10, "reference_views": 1_000_000_000}),
    ],
)
def test_what_cannot_be_planned_is_refused_before_anything_is_made(
    tmp_path: Path, spec: str, settings: dict[str, int]
) -> None:
    with pytest.raises(SpecError):
        run_farm(tmp_path, spec, **settings)
    assert list(tmp_path.iterdir()) == []


def test_the_run_of_a_further_network_lies_beside_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert up.run_beside(Path("runs/first"), "cnn") == Path("runs/first-cnn")
    assert up.run_beside(Path(), "cnn") == tmp_path.with_name(f"{tmp_path.name}-cnn")


def test_the_last_line_is_the_complete_one_also_where_a_process_fails(
    store: Store, redis_server: EmbeddedRedis, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=6), shard_rows=4).scene_id)
    (tmp_path / "trainer.log").write_text("no\n")
    trainer = subprocess.Popen([sys.executable, "-c", "raise SystemExit(8)"])
    worker = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    samples.commit_all(scene)
    watch = FarmWatch(store, redis_server.url)
    trainer.wait()
    try:
        with follow_up(store.root) as show, pytest.raises(IncompleteError):
            up._watch({"worker": worker, "trainer": trainer}, watch, redis_server, show, tmp_path)
    finally:
        worker.communicate(b"\n")
    assert capsys.readouterr().err.split(maxsplit=2)[2] == "small: samples 6/6\n"


@pytest.mark.parametrize("code", [SpecError.exit_code, 6, -9])
def test_what_failed_first_is_told_and_whether_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    ends = f"os.kill(os.getpid(), {-code})" if code < 0 else f"sys.exit({code})"

    def command(verb: str, *_: str) -> list[str]:
        does = f"print('no {verb}', flush=True); {ends if verb == 'work' else 'sys.exit(4)'}"
        return [sys.executable, "-c", f"import os, sys; {does}"]

    monkeypatch.setattr(up, "command", command)
    with pytest.raises(IncompleteError) as caught:
        run_farm(tmp_path)
    said = str(caught.value)
    assert said.startswith(f"worker-1 {'was ended by SIGKILL' if code < 0 else f'ended with exit code {code}'}; ")
    assert "says: no work. What is rendered" in said
    assert ("the same command goes on from there" in said) == (code != SpecError.exit_code)
    assert said.endswith("After that, photonfarm preview ended with exit code 4; what it said stands above")


def test_references_are_made_without_a_training_too_and_workers_keep_the_reserve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[tuple[str, ...]] = []

    def command(*arguments: str) -> list[str]:
        called.append(arguments)
        return [sys.executable, "-c", ""]

    monkeypatch.setattr(up, "command", command)
    run_farm(tmp_path, reference_views=1, reference_spp=64, reserve="2GB")
    (scene,) = Store(tmp_path / "store").scenes()
    assert [plan.request.kind for plan in scene.plans()] == ["samples", "top-up"]
    assert [arguments[:2] for arguments in called][1:] == [("store", "merge"), ("preview", scene.scene_id)]
    assert called[0][-2:] == ("--reserve", "2GB")


def test_a_run_that_ended_before_most_samples_had_landed_is_told_of(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "metrics.jsonl").write_text('{"kind": "end", "step": 9, "reason": "steps", "samples": 40}\n')
    for complete in (40, 96):
        up._tell_of_late_samples(tmp_path, complete, said.append)
    (line,) = said
    assert "step 9, when 40 of 96 samples had landed" in line
