from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.renderer.cli import report_stability
from photonfarm.renderer.stability import rows
from photonfarm.renderer.stability.case import Settings
from photonfarm.renderer.stability.truths import known


def call(tmp_path: Path, *arguments: str) -> Any:
    return CliRunner().invoke(report_stability, [*arguments, "--out", str(tmp_path / "out")])


def test_the_report_is_written_as_markdown_json_and_picture(tmp_path: Path) -> None:
    result = call(tmp_path, "--quick", "--only", "5", "--only", "30")
    assert result.exit_code == 0, result.output
    out = tmp_path / "out"
    text = (out / "stability.md").read_text(encoding="utf-8")
    assert "**2 of 2 rows pass**" in text
    assert "photonfarm report stability --quick --only 5 --only 30" in text
    assert "only the box filter is allowed" in text
    assert "smooth vertex normals" in text
    document = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert (document["rows_passed"], document["rows_run"], document["rows"]) == (2, 2, 36)
    assert {"z_max", "mean_ratio", "max_over_mean", "nan", "inf", "verdict"} <= set(document["results"][0])
    assert (out / "stability.png").stat().st_size > 0


def test_a_failing_row_gives_exit_code_one_its_command_and_its_renders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (empty,) = (scene for scene in rows.SCENES if scene.row == 5)
    wrong = replace(empty, truth=known(0.4, "a wrong number"), quick_settings=empty.settings[:1])
    monkeypatch.setattr(rows, "SCENES", (wrong,))
    monkeypatch.setattr(rows, "REFUSALS", ())
    result = call(tmp_path, "--quick")
    assert result.exit_code == 1
    assert "again: python bench/stability.py --only 05-empty --settings 1,1 --seed 0 --quick" in result.stderr
    kept = tmp_path / "out" / "failures" / "05-empty_1,1"
    assert np.load(kept / "bdpt.npy").shape == (12, 16, 16, 3)
    assert (kept / "bdpt_truth_z.png").is_file()
    assert "## Failures" in (tmp_path / "out" / "stability.md").read_text(encoding="utf-8")


def test_an_unknown_row_is_wrong_usage_and_names_the_known_ones(tmp_path: Path) -> None:
    result = call(tmp_path, "--quick", "--only", "37")
    assert result.exit_code == 2
    assert "'37'" in result.stderr
    assert "13-glass-caustic" in result.stderr


def test_rows_are_chosen_by_number_name_label_and_settings() -> None:
    with pytest.raises(ValueError, match=r"14-point-caustic is tried with 1,1 or"):
        rows.chosen(["14"], settings=[Settings(0, 0.0)])
    assert "point-caustic" not in {item.name for item in rows.chosen(settings=[Settings(0, 0.0)])}
    (by_name,) = rows.chosen(["cove"])
    (by_label,) = rows.chosen(["11-cove"])
    assert [by_name] == [by_label] == rows.chosen(["11"])
    assert {item.row for item in rows.chosen()} - {None} == set(range(1, 37))
