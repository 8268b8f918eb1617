"""The grid search: cells that differ in nothing else, kept where finished, compared in pairs."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from analytic_room import analytic_base, analytic_spec
from analytic_room_samples import AnalyticSource, commit_job
from click.testing import CliRunner

from bench.trainer import grid_search
from bench.trainer.grid_search import Cell, main, run_grid, table
from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.core.statistics import Estimate
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.plan.request import Request
from photonfarm.store import Store
from photonfarm.trainer.predictors.evaluation import HeldOutErrors
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.learner import DivergedError
from photonfarm.trainer.training.loop import train

AXES = {"optimiser": ("adam", "rmsprop"), "learning_rate": (1e-4, 2e-3)}


def make_source(samples: int, **how: int) -> AnalyticSource:
    """A source of so many samples of a small analytic room; how: views=, per_look=."""
    return AnalyticSource(analytic_spec(16, 256), samples, **how)


def tiny(**changes: object) -> TrainSettings:
    """Settings of a tiny network on tiny batches, with changes."""
    described = {"network": NetworkSettings(width=4), "batch": 3, "hold_out": 0.25, "poll_seconds": 0.01}
    described |= {"max_steps": 12, "validate_every": 5, "checkpoint_every": 4, "validation_samples": 8}
    return TrainSettings.model_validate({**described, **changes})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a search."""
    return tmp_path / "run"


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Cell]]:
    """The folder of a grid of four cells, and what it found."""
    folder = tmp_path_factory.mktemp("searched")
    return folder, run_grid(lambda: make_source(24), tiny(), folder, AXES)


def test_every_cell_is_the_run_that_its_settings_make_alone(searched, tmp_path) -> None:
    run, cells = searched
    assert [cell.changes["optimiser"] for cell in cells] == ["adam", "adam", "rmsprop", "rmsprop"]
    outcome = train(make_source(24), tiny(optimiser="rmsprop", learning_rate=2e-3), tmp_path / "alone")
    states = [checkpoint.load(path / CHECKPOINT) for path in (tmp_path / "alone", run / "rmsprop-0.002")]
    assert all(np.array_equal(states[0]["network"][name], states[1]["network"][name]) for name in states[0]["network"])
    assert np.mean(cells[-1].picked_by + cells[-1].per_unit) == pytest.approx(outcome.last_error, rel=1e-5)
    assert len({cell.error.mean for cell in cells}) == 4


def test_all_cells_draw_the_same_samples_in_the_same_order(searched) -> None:
    run, _ = searched
    states = [checkpoint.load(path)["following"] for path in sorted(run.glob(f"*/{CHECKPOINT}"))]
    followed = [json.dumps(state, default=lambda numbers: numbers.tolist()) for state in states]
    assert len(followed) == 4
    assert all(state == followed[0] for state in followed)


def test_finished_cells_are_kept_and_new_ones_are_added(run) -> None:
    opened = []

    def make():
        opened.append(make_source(24))
        return opened[-1]

    first = run_grid(make, tiny(), run, {"learning_rate": (1e-4,)})
    so_far = len(opened)
    assert run_grid(make, tiny(), run, {"learning_rate": (1e-4,)}) == first
    assert len(opened) == so_far + 1, "one look at the samples, and no run"
    told: list[str] = []
    cells = run_grid(make, tiny(), run, {"learning_rate": (1e-4, 5e-4)}, log=told.append)
    assert cells[0] == first[0]
    assert len(cells) == 2
    assert len(told) == 1
    assert told[0].startswith("2 of 2: 0.0005: 0.")


def test_a_grid_that_was_stopped_within_a_cell_goes_on_to_the_same_figures(searched, tmp_path) -> None:
    _, whole = searched
    stop, broken = threading.Event(), tmp_path / "broken"

    def make():
        source = make_source(24)
        honest = source.read

        def read(row: int):
            if (broken / "rmsprop-0.0001").exists() and len(source.reads) > 15:
                stop.set()
            return honest(row)

        source.read = read
        return source

    begun = run_grid(make, tiny(), broken, AXES, stop=stop)
    assert len(begun) == 2
    assert 0 < checkpoint.load(broken / "rmsprop-0.0001" / CHECKPOINT)["step"] < 12
    assert run_grid(lambda: make_source(24), tiny(), broken, AXES) == whole


def test_a_cell_that_diverges_is_a_result(run, monkeypatch) -> None:
    def diverge(source, settings, folder, hooks):
        if settings.learning_rate == 1e-4:
            raise DivergedError("the loss is inf")
        return train(source, settings, folder, hooks)

    monkeypatch.setattr(grid_search, "train", diverge)
    cells = run_grid(lambda: make_source(24), tiny(), run, {"learning_rate": (1e-4, 5e-4)})
    assert [cell.error is None for cell in cells] == [True, False]
    assert table(cells).splitlines()[-1] == "| 0.0001 |  | diverged |  |"
    assert run_grid(lambda: make_source(24), tiny(), run, {"learning_rate": (1e-4, 5e-4)}) == cells


def test_the_files_hold_the_table_and_every_figure(run) -> None:
    cells = run_grid(lambda: make_source(24), tiny(), run, {"decay": (0.9, 1.0)})
    assert (run / "grid.md").read_text() == table(cells) + "\n"
    written = json.loads((run / "grid.json").read_text())
    assert written["samples"] == 24
    assert written["settings"] | {"decay": 1.0} == tiny(decay=1.0).model_dump(mode="json")
    assert "decay" not in written["settings"]
    assert [cell["mean"] for cell in written["cells"]] == [cell.error.mean for cell in cells]
    assert [cell["standard_error"] for cell in written["cells"]] == [cell.error.standard_error for cell in cells]


def test_the_best_is_picked_by_one_half_and_all_are_told_by_the_other_in_pairs() -> None:
    """The second half has 1, 2, 3 and 1.1, 2.1, 3.1: by pairs the difference is exactly 0.1, though the first is lower.

    A cell that is lucky on the half it is picked by is not told by its luck.
    """
    cells = [Cell({"decay": 1.0}, (0.9, 0.7), (1.0, 2.0, 3.0)), Cell({"decay": 0.95}, (0.2, 0.2), (1.1, 2.1, 3.1))]
    lines = table(cells).splitlines()
    assert lines[0] == "| decay | picked by | held-out error | more than the best |"
    assert lines[2] == "| 0.95 | 0.20000 | 2.10000 ± 0.57735 |  |"
    assert lines[3] == "| 1.0 | 0.80000 | 2.00000 ± 0.57735 | -0.10000 ± 0.00000 |"


def test_an_error_that_is_all_but_infinite_is_told_in_few_digits() -> None:
    cells = [Cell({"decay": 1.0}, (0.5, 0.5), (1.0, 1.0)), Cell({"decay": 0.95}, (3.2e30, 3.2e30), (1e12, 3e12))]
    assert table(cells).splitlines()[3] == "| 0.95 | 3.2e+30 | 2e+12 ± 1e+12 | 2e+12 ± 1e+12 |"


def test_each_held_out_configuration_is_in_one_half_by_what_it_is(run) -> None:
    """Views of one configuration stay together, and the order in which they come does not matter."""
    source = make_source(48, views=2)
    source.refresh()
    rows = [row for row, held in zip(range(48), rows_held_out(source, range(48), 0.5), strict=True) if held]
    assert len(rows) > 12
    units = tuple(source.modification_keys(rows))

    def halves(order: list[int]) -> tuple[set[float], set[float]]:
        errors = np.array([rows[i] // 2 for i in order], float)  # the number of its configuration stands for an error
        found = HeldOutErrors(Estimate.of(errors), 0.0, errors, errors, tuple(units[i] for i in order))
        first, second = grid_search._halves(found)
        assert len(first) == len(set(units)) // 2
        assert len(first) + len(second) == len(set(units))
        return set(first), set(second)

    straight, reversed_ = halves(list(range(len(rows)))), halves(list(reversed(range(len(rows)))))
    assert straight == reversed_
    assert not straight[0] & straight[1]
    assert max(straight[0]) > min(straight[1]), "the halves are not by the order of arrival"


def test_a_grid_needs_a_configuration_for_each_half(run) -> None:
    with pytest.raises(IncompleteError):
        run_grid(lambda: make_source(24), tiny(hold_out=0.01), run, AXES)
    assert not run.exists()


def test_samples_that_are_missing_are_waited_for_elsewhere(run) -> None:
    with pytest.raises(IncompleteError, match="9 of 24"):
        run_grid(lambda: make_source(24, per_look=9), tiny(), run, AXES)


@pytest.mark.parametrize(
    ("change", "samples", "found"),
    [
        ({"seed": 3}, 24, "seed = 0, now 3"),
        ({"max_steps": 5}, 24, "max_steps = 12, now 5"),
        ({}, 27, "samples = 24, now 27"),
    ],
)
def test_a_grid_is_not_continued_as_another_one(run, change, samples, found) -> None:
    run_grid(lambda: make_source(24), tiny(max_steps=12), run, {"decay": (1.0,)})
    with pytest.raises(SpecError, match=found):
        run_grid(lambda: make_source(samples), tiny(**change), run, {"decay": (1.0,)})


def test_a_grid_keeps_what_is_not_asked_for_and_tells_of_what_is(run) -> None:
    """Another value of an axis, then both: neither is trained again."""
    (first,) = run_grid(lambda: make_source(24), tiny(decay=0.9), run, {"decay": (0.9,)})
    (second,) = run_grid(lambda: make_source(24), tiny(decay=1.0), run, {"decay": (1.0,)})
    assert [first.changes, second.changes] == [{"decay": 0.9}, {"decay": 1.0}]
    assert [cell["changes"] for cell in json.loads((run / "grid.json").read_text())["cells"]] == [
        {"decay": 0.9},
        {"decay": 1.0},
    ]
    assert (run / "grid.md").read_text() == table([second]) + "\n"
    shutil.rmtree(run / "0.9")
    assert run_grid(lambda: make_source(24), tiny(), run, {"decay": (1.0, 0.9)}) == [first, second]
    assert (run / "grid.md").read_text() == table([first, second]) + "\n"


@pytest.mark.parametrize("text", ["xx", "{}", "[]"])
def test_a_file_that_no_grid_left_is_named(run, text: str) -> None:
    run.mkdir()
    (run / "grid.json").write_text(text)
    with pytest.raises(StoreError, match=r"grid\.json"):
        run_grid(lambda: make_source(24), tiny(), run, {"decay": (1.0,)})


def test_an_axis_that_cannot_be_is_named_before_anything_runs(run) -> None:
    with pytest.raises(SpecError, match=r"decay = 1\.5"):
        run_grid(lambda: make_source(24), tiny(), run, {"decay": (1.0, 1.5)})
    assert not run.exists()


def test_the_command_searches_what_is_not_set_and_prints_the_table(run, tmp_path) -> None:
    settings = ["--optimiser", "rmsprop", "--steps", "2", "--hold-out", "0.4", "--architecture", "cnn"]
    settings += ["--set", "width=4", "--set", "schedule=epochs"]
    command = ["--store", str(tmp_path / "store"), "--run", str(run), *settings]
    scene = Store(tmp_path / "store", create=True).add(analytic_spec(16, 256))
    scene.write_base(*analytic_base(scene.spec))
    scene.plan(Request(modifications=16, views_per_modification=1, passes=1), shard_rows=8)
    refused = CliRunner().invoke(main, command)
    assert refused.exit_code == IncompleteError.exit_code
    assert refused.stdout == ""
    for job in scene.missing_jobs():
        commit_job(scene, job)
    found = CliRunner().invoke(main, command)
    assert found.exit_code == 0, found.output
    assert len(found.stdout.splitlines()) == 2 + 4, "a line for each rate"
    assert "| rmsprop | 0.002 | 0.99 |" in found.stdout
    assert "decay is not searched" in found.stderr
    assert "4 of 4: rmsprop-0.002-0.99: " in found.stderr
    assert (run / "grid.md").read_text() == found.stdout


def test_a_store_that_is_not_there_or_has_no_scene_is_refused_and_leaves_no_folder(run, tmp_path) -> None:
    Store(tmp_path / "store", create=True)
    assert CliRunner().invoke(main, ["--store", str(tmp_path / "store"), "--run", str(run)]).exit_code == 3
    assert CliRunner().invoke(main, ["room", "--store", str(tmp_path / "none"), "--run", str(run)]).exit_code == 4
    assert not run.exists()
