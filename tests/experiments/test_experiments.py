"""The way through all stages of a tiny experiment."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import experiment, free_space, run
from experiments.dry_run import Need
from experiments.equal_time import place_rows
from experiments.experiment import Experiment, Size, keep_free_space, merge
from experiments.paper_tables import format_errors
from experiments.path_tracing import SPP
from experiments.rooms import Room
from experiments.stages import COMMITS, PREVIEW, StageError, Stages, _is_done
from experiments.tables import format_page
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.plan.sample_costs import SampleCosts
from photonfarm.scene.free_space import FreeSpace, pack
from photonfarm.trainer.report.contents import MOVABLE_LIGHTS

TINY = """
title = "A tiny room"
part = "movable"
about = "For the test."
scene = "room.toml"

[small]
"""
SIZES = """
[small]
about = "tiny"
changes = { film = { width = 16, height = 16 }, transport = { half_spp = 1 }, points = 256, photons = { paths = 64 } }
modifications = 12
views = 1
seed = 0
seeds = [0, 1]
hold_out = 0.4
references = { views = 2, spp = 4 }
architectures = ["light_transport", "denoise_4"]
untrained = ["fill-in"]
kept = [4]
halves = [2]

[small.train]
preset = "small"
max_steps = 3
width = 4
points = 128
loss = "relative"
"""


def keep_all_free(name: str) -> None:
    """Write down that an experiment's cameras may stand anywhere in their box."""
    digest = Experiment.load(name, "small").spec_without_free_space().free_space_digest
    keep_free_space(name, FreeSpace(of=digest, cells=(1, 1, 1), free=pack(np.ones((1, 1, 1), np.bool_))))


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Experiment:
    from photonfarm.scene.spec_loading import find_spec

    monkeypatch.setattr(experiment, "HERE", tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    (tmp_path / "sizes.toml").write_text(SIZES)
    (tmp_path / "room.toml").write_text(find_spec("room").read_text())
    keep_all_free("tiny")
    return Experiment.load("tiny", "small")


def test_an_experiment_without_free_space_of_its_scene_is_refused(tiny: Experiment) -> None:
    before = tiny.spec_without_free_space()
    assert tiny.spec().view.free_space.of == before.free_space_digest
    assert tiny.spec().scene_id != before.scene_id
    box = {"min": [-1, 1, -1], "max": [1, 2, 1]}
    for other in (
        tiny.model_copy(update={"name": "other"}),
        tiny.model_copy(update={"changes": {"view": {"origin": box}}}),
    ):
        with pytest.raises(SpecError, match=rf"free_space\.py {other.name}`"):
            other.spec()


@pytest.mark.slow
def test_free_space_is_measured_for_an_experiment_s_own_groups(
    tiny: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_everywhere = tiny.spec()
    monkeypatch.setattr(sys, "argv", ["free_space.py", "tiny"])
    assert free_space.main() == 0
    measured = tiny.spec()
    assert measured.view.free_space.of == open_everywhere.view.free_space.of
    assert list(measured.view.free_space.groups) == [group.name for group in measured.groups]
    monkeypatch.setattr(sys, "argv", ["free_space.py", "other"])
    assert free_space.main() == SpecError.exit_code


def with_size(tiny: Experiment, **changes: Any) -> Experiment:
    return tiny.model_copy(update={"size": tiny.size.model_copy(update=changes)})


SMALLEST_CARD = """
title = "A room for a card"
part = "movable"
about = "For the test."
scene = "room.toml"

[card]
about = "as the size card, but for its numbers"
changes = { film = { width = 32, height = 32 }, transport = { half_spp = 1 }, points = 256, photons = { paths = 64 } }
modifications = 16
hold_out = 0.4
references = { views = 2, spp = 32 }  # as many passes as denoisers are given halves of

[card.train]
max_steps = 3
width = 4
points = 128
"""


def call_run(monkeypatch: pytest.MonkeyPatch, work: Path, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["run.py", "room-of-a-card", "--size", "card", "--work", str(work), *arguments])
    return run.main()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.usefixtures("tiny")
def test_the_size_card_runs_to_its_end_and_goes_on_where_its_minutes_were_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of what sizes.toml says of it, at another film, width and number of images and steps."""
    shutil.copy(Path(experiment.__file__).with_name("sizes.toml"), tmp_path)
    (tmp_path / "tiny.toml").unlink()
    (tmp_path / "room-of-a-card.toml").write_text(SMALLEST_CARD)
    keep_all_free("room-of-a-card")
    found, work = Experiment.load("room-of-a-card", "card"), tmp_path / "work"
    stages = Stages(found, work / "card" / found.name, 2)
    stages.write_spec()
    stages.render()

    assert call_run(monkeypatch, work, "--minutes", "0.2") == IncompleteError.exit_code
    names = [run.name for run in found.trained()]
    begun = [(stages.folder / "logs" / f"train-{name}.log").is_file() for name in names]
    assert len(names) == 16
    assert begun == sorted(begun, reverse=True), "the most telling come first"
    assert not begun[-1]
    ended = [stages._checkpoint(run) for run in found.trained() if stages._is_trained(run)]
    before = [file.stat().st_mtime_ns for file in ended]
    assert call_run(monkeypatch, work) == 0
    assert before == [file.stat().st_mtime_ns for file in ended]

    report = json.loads((stages.folder / "report/report.json").read_text())
    halves = [f"{count}/1" for count in found.size.halves]
    several = [f"guided_denoise {amount}" for amount in halves]
    ready = [f"{name} {amount}" for of in (["1/1", "1/4"], halves) for name in found.size.untrained for amount in of]
    assert [row["name"] for row in report["evaluation"]["rows"]] == [*names, *several, *ready]
    assert all(run["steps"] == 3 and run["settings"]["batch"] == 8 for run in report["runs"])
    assert all(run["settings"]["network"]["precision"] == "bfloat16" for run in report["runs"])
    page = " ".join(format_page([Room.read(found, stages.folder / "report/report.json", "1234567")], "card").split())
    assert "averaged weights, bfloat16, scaled rates of layers" in page


def test_what_does_not_begin_for_want_of_time_leaves_no_commit(tiny: Experiment, tmp_path: Path) -> None:
    with pytest.raises(StageError):
        Stages(tiny, tmp_path / "work", 1, until=0).train()
    assert not (tmp_path / "work").exists()


@pytest.mark.slow
def test_stages_stop_when_their_time_is_over_and_the_same_command_goes_on(tiny: Experiment, tmp_path: Path) -> None:
    """Training ends by its seconds, which counts as its end."""
    endless = with_size(tiny, train={**tiny.size.train, "max_steps": 100_000, "max_seconds": 4}, seeds=(0,))
    begun = Stages(endless, tmp_path / "work", 1)
    begun.write_spec()
    begun.render()
    with pytest.raises(StageError, match=r"train-light_transport was stopped; the same command goes on"):
        Stages(endless, tmp_path / "work", 1, until=time.monotonic() + 3).train()
    with pytest.raises(StageError, match="the time is over before train-light_transport"):
        Stages(endless, tmp_path / "work", 1, until=0).train()
    begun.train()
    before = {run: run.stat().st_mtime_ns for run in (tmp_path / "work").glob("runs/*/checkpoint*")}
    begun.train()
    assert len(before) == 2
    assert before == {run: run.stat().st_mtime_ns for run in before}


def test_what_would_begin_anew_comes_to_its_end_after_its_time(tiny: Experiment, tmp_path: Path) -> None:
    made, late = tmp_path / "made", ["import sys, time; time.sleep(0.6); open(sys.argv[1], 'w')"]
    stages = Stages(tiny, tmp_path, 1, until=time.monotonic() + 0.2)
    stages._verb("report", [made], made=[made], program=[sys.executable, "-c", *late])
    assert made.is_file()
    with pytest.raises(StageError, match="the time is over before path"):
        stages._verb("path", [made], made=[made], program=[sys.executable, "-c", *late])


def test_a_dry_run_counts_samples_passes_and_operations(tiny: Experiment) -> None:
    need = Need.of(tiny, SampleCosts("0" * 32, 1.0, 2.0, 3.0, 0.5, 0.1))
    assert (need.samples, need.passes, need.runs) == (12, 2, 3)  # 2 spp a pass; a network twice, and a denoiser
    assert need.sample_hours == pytest.approx(12 * (1 + 2 + 3 + 2 * 0.5) / 3600)
    assert need.pass_hours == pytest.approx(2 * (3 + 2 * 0.5) / 3600)
    longer = Need.of(with_size(tiny, train={**tiny.size.train, "max_steps": 6}), SampleCosts("0" * 32, 1, 1, 1, 1, 0))
    assert longer.operations == pytest.approx(2 * need.operations)


DRY_RUN = """
import sys
from pathlib import Path
from experiments import experiment, run
experiment.HERE = Path(sys.argv.pop(1))
sys.exit(run.main())
"""


@pytest.mark.slow
def test_a_dry_run_measures_the_scene_in_a_process_that_has_loaded_nothing(tiny: Experiment) -> None:
    command = [sys.executable, "-c", DRY_RUN, str(experiment.HERE), "tiny", "--dry-run"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert re.fullmatch(r"tiny: 12 samples \S+ core-h; 2 further passes .*; 3 runs \S+ operations\n", said)


def reports(stages: Stages) -> list[int]:
    """The times at which preview and log of the farm, checkpoints, references and the report were written."""
    files = [*stages.folder.glob("runs/*/checkpoint*"), *stages.folder.glob("references/*.npz")]
    files = [*sorted(files), *(stages.folder / name for name in (PREVIEW, "logs/render.log", "report/report.json"))]
    return [file.stat().st_mtime_ns for file in files]


@pytest.mark.slow
def test_all_stages_lead_to_a_report_and_are_not_done_twice(tiny: Experiment, tmp_path: Path) -> None:
    first, stages = (Stages(tiny, tmp_path / "work", workers) for workers in (1, 2))  # each compiles all kernels
    first.write_spec()
    first.render()
    stages.train()
    out = stages.report()
    report = json.loads((out / "report.json").read_text())
    rows = report["evaluation"]["rows"]
    assert [row["name"] for row in rows] == ["light_transport", "denoise_4", "fill-in 1/4", "fill-in 2/1"]
    references = report["evaluation"]["references"]
    assert (references["views"], references["spp"]) == (2, 4)
    assert rows[1]["frame_seconds"]["render"] > 0
    assert report["dataset"]["free_space"]
    assert [run["steps"] for run in report["runs"]] == [3, 3]
    assert list(report["trained_at"]) == ["light_transport", "denoise_4", "light_transport-seed-1"]

    room = Room.read(tiny, out / "report.json", "1234567")
    assert room.commits() == report["trained_at"]["light_transport"]
    assert (room.spent("samples")["rows"], room.spent("top-up")["rows"]) == (12, 2)
    assert "| denoise_4 |" in format_errors([room], MOVABLE_LIGHTS)
    paths = [f"path {spp} spp" for spp in SPP]
    assert [len(room.errors(name)) for name in room.rows] == [2, 1, 1, 1, *[1] * len(paths)]
    assert place_rows(room, paths)[-1].name == paths[-1], "which takes longest"
    assert room.mse(paths[-1]).mean < room.mse(paths[0]).mean

    before = reports(stages)
    assert stages.run() == out
    assert reports(stages) == before

    strange = tmp_path / "work" / "references" / "notes.txt"
    strange.write_text("Not ours.")
    fewer = tiny.size.references.model_copy(update={"views": 1})
    Stages(with_size(tiny, references=fewer), tmp_path / "work", workers=2).render()
    assert len(list(strange.parent.glob("*.npz"))) == 1
    assert strange.is_file()

    shutil.rmtree(tmp_path / "work" / "store")  # a report that is made anew, as references are others, ends at once
    with pytest.raises(StageError):
        stages.report()


@pytest.mark.parametrize(
    "since",
    ["nothing", "it did not end", "other arguments", "an output is missing", "a source is newer", "a source is as old"],
)
def test_a_verb_is_done_until_its_arguments_what_it_is_made_of_or_what_it_made_change(
    tmp_path: Path, since: str
) -> None:
    end, *made = (tmp_path / name for name in ("end", "made", "made too"))
    of = [tmp_path / name for name in ("old", "older")]
    for second, file in enumerate([*reversed(of), *made, end]):
        file.write_text("as told")
        os.utime(file, (second, second))
    if since == "it did not end":
        end.unlink()
    elif since == "an output is missing":
        made[1].unlink()
    elif since.startswith("a source"):
        second = end.stat().st_mtime + (since == "a source is newer")
        os.utime(of[1], (second, second))
    asked = "otherwise" if since == "other arguments" else "as told"
    assert _is_done(end, asked, made, of) is (since == "nothing")


def test_a_stage_that_fails_says_which_and_where_its_output_is(tiny: Experiment, tmp_path: Path) -> None:
    refused = with_size(tiny, train={**tiny.size.train, "loss": "l1"}, architectures=("light_transport",), seeds=(0,))
    stages = Stages(refused, tmp_path / "work", workers=1)
    stages.write_spec()
    with pytest.raises(StageError, match=r"tiny: train-light_transport .* 3; .*train-light_transport"):
        stages.train()


def test_kept_pixels_are_asked_for_with_denoisers_that_come_ready_alone(
    tiny: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`photonfarm report` refuses --kept without --denoiser."""
    monkeypatch.setattr(Stages, "_tell_commits", lambda *_: None)
    for untrained in (("oidn",), ()):
        asked: list[str] = []
        monkeypatch.setattr(Stages, "_verb", lambda _, __, given, asked=asked, **___: asked.extend(map(str, given)))
        Stages(with_size(tiny, untrained=untrained), tmp_path / "work", workers=1).report()
        assert ("--kept" in asked) is ("--halves" in asked) is ("--denoiser" in asked) is bool(untrained)


def test_training_that_ends_early_without_an_error_is_not_taken_for_done(
    tiny: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that SIGTERM stopped, whose exit code is 0."""
    stages = Stages(with_size(tiny, architectures=("light_transport",), seeds=(0,)), tmp_path / "work", workers=1)
    stages.write_spec()
    monkeypatch.setattr(Stages, "_verb", lambda *_, **__: None)
    with pytest.raises(StageError, match="stopped early"):
        stages.train()


def trained(experiment: Experiment, folder: Path, step: int) -> Stages:
    """The stages of an experiment of one network, of which a checkpoint of some step is there."""
    from photonfarm.trainer.runs import checkpoint
    from photonfarm.trainer.runs.settings import make_preset

    told = {key: experiment.size.train[key] for key in ("max_steps", "loss")}
    network = {"architecture": "light_transport", "width": 4, "points": 128}
    settings = make_preset("small", network=network, hold_out=experiment.size.hold_out, **told)
    state = {"scene_id": experiment.spec().scene_id, "settings": settings.model_dump(mode="json"), "step": step}
    state["seconds"] = {"train": 1.0}
    (folder / "runs" / "light_transport").mkdir(parents=True)
    checkpoint.save(folder / "runs" / "light_transport" / "checkpoint.safetensors", state)
    return Stages(experiment, folder, workers=1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"train": {"decay": 0.5}}, r"decay = 0\.99, and 0\.5"),
        ({"train": {"preset": "paper-static"}}, "batch = 2, and 128"),
        ({"hold_out": 0.3}, r"hold_out = 0\.4, and 0\.3"),
        ({"changes": {"points": 512}}, "scene_id = "),
    ],
)
def test_a_run_of_other_settings_is_refused_with_its_folder(
    tiny: Experiment, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    tiny = with_size(tiny, architectures=("light_transport",), seeds=(0,))
    trained(tiny, tmp_path / "work", step=3).train()
    assert not (tmp_path / "work" / "logs").exists()  # nothing had to be done
    other = tiny.model_copy(update={"size": Size.model_validate(merge(tiny.size.model_dump(), changes))})
    with pytest.raises(StageError, match=rf"work/runs/light_transport was trained with .*{said}"):
        Stages(other, tmp_path / "work", workers=1).train()


def test_a_run_that_its_rounds_ended_has_come_to_its_end(tiny: Experiment, tmp_path: Path) -> None:
    tiny = with_size(tiny, architectures=("light_transport",), seeds=(0,))
    stages = trained(tiny, tmp_path / "work", step=1)
    (run,) = tiny.trained()
    log = tmp_path / "work/runs/light_transport/metrics.jsonl"
    for reason, is_its_end in (("stopped", False), ("rounds", True), ("learned by heart", True)):
        log.write_text(json.dumps({"step": 1, "kind": "end", "reason": reason}) + "\n")
        assert stages._is_trained(run) is is_its_end


def test_a_run_keeps_every_commit_that_it_was_trained_at_and_the_report_tells_them(
    tiny: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = Stages(with_size(tiny, architectures=("light_transport",)), tmp_path / "work", workers=1)
    first, again = stages._runs()
    for commit in ("1234567", "89abcde", "89abcde"):
        monkeypatch.setattr("bench.harness.results.commit", lambda commit=commit: commit)
        stages._keep_commit(first)
    assert json.loads((tmp_path / "work/runs" / first.name / COMMITS).read_text()) == ["1234567", "89abcde"]
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"edit_seconds": 0.1}))
    stages._tell_commits(report)
    told = json.loads(report.read_text())
    assert told == {"edit_seconds": 0.1, "trained_at": {first.name: ["1234567", "89abcde"], again.name: []}}
