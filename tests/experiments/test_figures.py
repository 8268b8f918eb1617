"""The figures over a report: which of its pictures stand where, and what is said of them."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import figures
from experiments.figures import OURS, PUBLISHED, REFERENCE, Report
from photonfarm.core.errors import IncompleteError
from photonfarm.core.pictures import write_png
from photonfarm.trainer.compare.evaluation_page import COMPARISON, draw_comparison
from photonfarm.trainer.compare.evaluation_samples import Target

FIRST = [22, 55, 64, 65]
WORST = {"mirrors and clear glass": 64, "specular surfaces": 305, "near surfaces": 22, "all pixels": 64}
"""Two of three worst views are among the first ones."""

PREDICTORS = (PUBLISHED, *OURS)


def grey(row: int, column: int) -> np.ndarray:
    """An image that tells which row of the store and which column it is of."""
    return np.full((8, 8, 3), (row + 100 * column) / 1000, np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A report of three predictors, with its pictures as `photonfarm report` lays them."""
    shown = [*FIRST, 305]
    targets = tuple(Target(row, grey(row, 0), 256, is_reference=True, half_a=grey(row, 0)) for row in shown)
    rows = [
        SimpleNamespace(name=name, shown={row: grey(row, column) for row in shown})
        for column, name in enumerate(PREDICTORS, start=1)
    ]
    write_png(draw_comparison(SimpleNamespace(shown=targets, rows=rows)), tmp_path / COMPARISON)  # type: ignore[arg-type]
    document = {
        "evaluation": {"rows": [{"name": name} for name in PREDICTORS], "shown": shown},
        "worst_cases": [{"kind": kind, "row": row} for kind, row in WORST.items()],
    }
    (tmp_path / "report.json").write_text(json.dumps(document))
    return tmp_path


def linear(tile: np.ndarray) -> np.ndarray:
    """What was shown, but for the rounding of the display."""
    return (tile / 255) ** 2.2


def test_a_tile_is_that_of_its_row_also_where_a_worst_view_is_among_the_first(folder: Path) -> None:
    report = Report(folder)
    assert report.first == [22, 55, 64]
    assert report.worst == {
        64: ["mirrors and clear glass", "all pixels"],
        305: ["specular surfaces"],
        22: ["near surfaces"],
    }
    for column, name in enumerate((REFERENCE, *PREDICTORS)):
        assert list(report.tiles[name]) == [*FIRST, 305]
        for row, tile in report.tiles[name].items():
            np.testing.assert_allclose(linear(tile), grey(row, column)[0, 0, 0], atol=0.005)


def test_sheets_have_a_row_for_each_view_and_below_predictions_one_of_errors(folder: Path) -> None:
    sheet, tile = figures.draw_predictions(Report(folder), list(PREDICTORS)), figures.SIZE + figures.GAP
    assert sheet.shape[1] == (1 + len(PREDICTORS)) * tile - figures.GAP
    assert sheet.shape[0] // tile == 2 * figures.VIEWS
    assert figures.draw_worst_cases(Report(folder)).shape[0] // tile == 3


def test_a_folder_without_a_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(IncompleteError, match="holds no report"):
        Report(tmp_path)


def test_a_report_without_the_longer_runs_is_refused(folder: Path) -> None:
    report = Report(folder)
    figures.make_figures("night-living-room", report, folder)
    assert (folder / "night-living-room-worst.png").is_file()
    del report.tiles[PUBLISHED]
    with pytest.raises(IncompleteError, match=f"lacks {PUBLISHED}"):
        figures.make_figures("night-living-room", report, folder)
