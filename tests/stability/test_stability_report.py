from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stability import report, rows
from tests.stability.__main__ import main
from tests.stability.pictures import FULL_Z, SIDE, of_z, sheet
from tests.stability.runner import SceneResult, plus_minus, run
from tests.stability.scenes.case import BdptSettings
from tests.stability.scenes.truths import known


def call(tmp_path: Path, *arguments: str) -> int:
    return main([*arguments, "--out", str(tmp_path / "out")])


def test_the_report_is_written_as_markdown_json_and_picture(tmp_path: Path) -> None:
    assert call(tmp_path, "--quick", "--only", "5", "--only", "30") == 0
    out = tmp_path / "out"
    text = (out / "stability.md").read_text(encoding="utf-8")
    assert "**2 of 2 rows pass**, 2 of 2 scenes. There are 36 rows; the others were not tried." in text
    assert "python -m tests.stability --quick --only 5 --only 30" in text
    assert "only the box filter is allowed" in text
    assert "smooth vertex normals" in text
    document = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert (document["rows_passed"], document["rows_run"], document["rows"]) == (2, 2, 36)
    assert (document["scenes_passed"], document["scenes_run"]) == (2, 2)
    assert {"z_max", "mean_ratio", "max_over_mean", "nan", "inf", "verdict"} <= set(document["results"][0])
    assert (out / "stability.png").stat().st_size > 0


def test_a_failing_row_gives_exit_code_one_its_command_and_its_renders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (empty,) = (scene for scene in rows.SCENES if scene.row == 5)
    wrong = replace(empty, truth=known(0.4, "a wrong number"), quick_settings=empty.settings[:1])
    monkeypatch.setattr(rows, "SCENES", (wrong,))
    monkeypatch.setattr(rows, "REFUSALS", ())
    assert call(tmp_path, "--quick", "--settings", "1,1") == 1
    again = "again: python -m tests.stability --only 05-empty --settings 1,1 --seed 0 --quick"
    assert again in capsys.readouterr().err
    kept = tmp_path / "out" / "failures" / "05-empty_1,1"
    assert np.load(kept / "bdpt.npy").shape == (12, 16, 16, 3)
    assert (kept / "bdpt_truth_z.png").is_file()
    assert "## Failures" in (tmp_path / "out" / "stability.md").read_text(encoding="utf-8")


def rounding(mean_ratio: float, **changes: Any) -> SceneResult:
    """A result that differs by 60 standard errors of its noise, but by less than rounding may."""
    (refused,) = run(rows.REFUSALS[0], quick=True)
    return replace(
        refused.result,
        row=1,
        name="sphere",
        hard="all of it",
        truth="1 − ½^3",
        z_max=3.1,
        z_limit=5.4,
        mean_ratio=mean_ratio,
        mean_ratio_standard_error=4e-6,
        resolution=0.003,
        seen_bias=0.00046,
        seen_block_bias=4.5,
        max_over_mean=1.01,
        truth_max_over_mean=1.0,
        path_ratio=1.00066,
        path_ratio_standard_error=5e-6,
        **changes,
    )


def test_what_passes_as_rounding_is_marked_and_stands_beside_path() -> None:
    text = report.markdown(report.StabilityReport([rounding(1.00024)]), "made so")
    assert "| 1.0002400 ± 4.0e-06 ° (≤ 0.003) | 1.0006600 ± 5.0e-06 | 0.046 %, 450 % |" in text
    assert "- 01-sphere: `bdpt` +0.024 %, `path` +0.066 %" in text


def test_what_is_right_or_fails_is_not_called_rounding() -> None:
    for result in (rounding(1.00001), rounding(1.01, faults=("wrong",))):
        assert "° (≤" not in report.markdown(report.StabilityReport([result]), "made so")


def test_every_column_of_the_table_is_explained_in_a_line_of_its_own() -> None:
    text = report.markdown(report.StabilityReport([rounding(1.0)]), "made so")
    header = next(line for line in text.splitlines() if line.startswith("| row |"))
    explained = [line for line in text.splitlines() if line.startswith("- **")]
    for column in header.strip("| ").split(" | "):
        told = column.partition(":")[0]
        assert told in ("row", "scene", "verdict") or any(line.startswith(f"- **{told}**: ") for line in explained)


def test_what_is_hard_is_said_once_for_each_row() -> None:
    results = [rounding(1.0), rounding(1.0, settings="0,0"), replace(rounding(1.0), name="deep")]
    assert "## What is hard\n\n- 1: all of it\n" in report.markdown(report.StabilityReport(results), "made so")
    results.append(replace(rounding(1.0), name="dim", hard="light is rare"))
    text = report.markdown(report.StabilityReport(results), "made so")
    assert "- 1: *sphere, deep*: all of it; *dim*: light is rare\n" in text


def test_path_is_compared_with_an_exact_truth_and_with_no_other() -> None:
    by_label = {scene.label: scene for scene in rows.SCENES}
    (exact,) = run(by_label["05-empty"], quick=True, settings=[BdptSettings(1, 1.0)])
    assert exact.result.path_ratio == pytest.approx(1.0, abs=1e-5)
    (rendered,) = run(by_label["28-orthographic"], quick=True)
    assert rendered.result.path_ratio is None


def test_rows_and_scenes_are_counted_apart_and_refusals_without_a_row_by_themselves() -> None:
    (refused,) = run(rows.REFUSALS[0], quick=True)
    one = replace(refused.result, row=1, name="one")
    results = [
        one,
        replace(one, name="two", faults=("wrong",)),
        replace(one, row=2),
        replace(one, row=None, name="fog"),
    ]
    text = report.markdown(report.StabilityReport(results), "made so")
    assert "**1 of 2 rows pass**, 2 of 3 scenes and 1 of 1 further refusals." in text


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("37", "there is no row 37; allowed are 1 to 36"),
        ("0", "there is no row 0; allowed are 1 to 36"),
        ("13-glass-caustc", "there is no hard scene '13-glass-caustc'; do you mean '13-glass-caustic'?"),
    ],
)
def test_an_unknown_row_is_wrong_usage_and_answered_in_a_sentence(
    row: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        call(tmp_path, "--quick", "--only", row)
    assert ended.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"python -m tests.stability: error: {said}"


def test_errors_of_ratios_are_written_with_two_digits() -> None:
    assert plus_minus(1.0088, 0.0135) == "1.009 ± 0.013"
    assert plus_minus(1.000259974816193, 2.600382094274619e-05) == "1.000260 ± 0.000026"
    assert plus_minus(0.9999996651233783, 3.044665915863112e-10) == "0.9999997 ± 3.0e-10"
    assert plus_minus(1.0, 0.0) == "1.0000000 ± 0"


def test_colours_of_z_are_those_of_the_legend() -> None:
    z = np.array([[-FULL_Z, 0.0, FULL_Z], [-9.0, np.nan, 9.0]])
    blue, white, red, black = (0, 0, 255), (255, 255, 255), (255, 0, 0), (0, 0, 0)
    np.testing.assert_array_equal(of_z(z), [[blue, white, red], [blue, black, red]])
    sheet_of_one = np.asarray(sheet([("one", np.zeros((SIDE, 3 * SIDE, 3), np.uint8))]))
    legend = sheet_of_one[: sheet_of_one.shape[0] - SIDE]
    for colour in (blue, red):
        assert (legend == colour).all(axis=-1).any()


def test_rows_are_chosen_by_number_name_label_and_settings() -> None:
    with pytest.raises(ValueError, match="14-point-caustic"):
        rows.chosen(["14"], settings=[BdptSettings(0, 0.0)])
    assert "point-caustic" not in {item.name for item in rows.chosen(settings=[BdptSettings(0, 0.0)])}
    (by_name,) = rows.chosen(["cove"])
    (by_label,) = rows.chosen(["11-cove"])
    assert [by_name] == [by_label] == rows.chosen(["11"])
    assert {item.row for item in rows.chosen()} - {None} == set(range(1, 37))
