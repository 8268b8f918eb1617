from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.stability import report, rows
from tests.stability.__main__ import main
from tests.stability.report import FULL_Z, StabilityReport, of_z
from tests.stability.runner import SceneResult, plus_minus, run
from tests.stability.scenes.case import BdptSettings, known


def call(tmp_path: Path, *arguments: str) -> int:
    return main([*arguments, "--out", str(tmp_path / "out")])


def test_the_report_is_written_as_markdown_json_and_picture(tmp_path: Path) -> None:
    assert call(tmp_path, "--quick", "--only", "5", "--only", "30") == 0
    out = tmp_path / "out"
    text = (out / "stability.md").read_text(encoding="utf-8")
    assert "**2 of 2 rows pass**, 2 of 2 scenes. There are 36 rows; the others were not tried." in text
    assert "python -m tests.stability --quick --only 5 --only 30" in text
    assert "only the box filter is allowed" in text
    assert "- 05-empty: Nothing but a constant sky" in text
    document = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert (document["rows_passed"], document["rows_run"], document["rows"]) == (2, 2, 36)
    assert {"z_max", "mean_ratio", "max_over_mean", "not_finite", "verdict"} <= set(document["results"][0])
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


def refused() -> SceneResult:
    (outcome,) = run(rows.REFUSALS[0], quick=True)
    return outcome.result


def test_every_column_of_the_table_is_explained_in_a_line_of_its_own() -> None:
    text = report.markdown(StabilityReport([refused()]), "made so")
    header = next(line for line in text.splitlines() if line.startswith("| row |"))
    explained = [line for line in text.splitlines() if line.startswith("- **")]
    for column in header.strip("| ").split(" | "):
        assert column in ("row", "scene", "verdict") or any(line.startswith(f"- **{column}**: ") for line in explained)


def test_rows_and_scenes_are_counted_apart_and_refusals_without_a_row_by_themselves() -> None:
    one = replace(refused(), row=1, label="01-one")
    results = [
        one,
        replace(one, label="01-two", faults=("wrong",)),
        replace(one, row=2, label="02-one"),
        replace(one, row=None, label="fog"),
    ]
    text = report.markdown(StabilityReport(results), "made so")
    assert "**1 of 2 rows pass**, 2 of 3 scenes and 1 of 1 further refusals." in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--only", "37"], "there is no hard scene '37'; allowed are the rows 1 to 36 and their names"),
        (["--only", "14", "--settings", "0,0"], "14 is not tried with these settings, or has no quick version"),
        (["--settings", "1,1,bright"], "settings are '1,1,bright'; allowed is connections,light_ratio[,guided]"),
    ],
)
def test_an_unknown_row_is_wrong_usage_and_answered_in_a_sentence(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        call(tmp_path, "--quick", *arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"python -m tests.stability: error: {said}"


def test_errors_of_ratios_are_written_with_two_digits() -> None:
    assert plus_minus(1.0088, 0.0135) == "1.009 ± 0.013"
    assert plus_minus(0.9999996651233783, 3.044665915863112e-10) == "0.9999997 ± 3.0e-10"
    assert plus_minus(1.0, 0.0) == "1.0000000 ± 0"


def test_colours_of_z_are_those_of_the_legend() -> None:
    z = np.array([[-FULL_Z, 0.0, FULL_Z], [-9.0, np.nan, 9.0]])
    blue, white, red, black = (0, 0, 255), (255, 255, 255), (255, 0, 0), (0, 0, 0)
    np.testing.assert_array_equal(of_z(z), [[blue, white, red], [blue, black, red]])


def test_rows_are_chosen_by_number_name_label_and_settings() -> None:
    assert "point-caustic" not in {item.name for item in rows.choose(settings=[BdptSettings(0, 0.0)])}
    (by_name,) = rows.choose(["cove"])
    (by_label,) = rows.choose(["11-cove"])
    assert [by_name] == [by_label] == rows.choose(["11"])
    assert {item.row for item in rows.choose()} - {None} == set(range(1, 37))
