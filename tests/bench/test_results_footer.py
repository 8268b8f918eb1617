"""Pages of results say at which commit they were made, and what they compare."""

from __future__ import annotations

import json
import subprocess
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

import compare_with_path
import results
from photonfarm.shared.core.statistics import block_z_test


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=tester", "-c", "user.email=tester@localhost"]
    ran = subprocess.run(["git", *identity, *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return ran.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one commit, whose docs/results is where the tables go."""
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    (tmp_path / "code.py").write_text("a = 1\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    monkeypatch.setattr(results, "FOLDER", folder)
    return tmp_path


def test_a_footer_names_the_commit(checkout: Path) -> None:
    head = git(checkout, "rev-parse", "--short", "HEAD")
    assert results.commit() == head
    assert f"at commit {head} (" in results.footer("cost")


def test_changes_that_are_not_committed_are_told(checkout: Path) -> None:
    (checkout / "code.py").write_text("a = 2\n")
    assert results.commit().endswith(" with uncommitted changes")


def test_results_that_are_being_written_are_no_changes(checkout: Path) -> None:
    (checkout / "docs" / "results" / "cost.md").write_text("# Cost\n")
    assert results.commit() == git(checkout, "rev-parse", "--short", "HEAD")


def test_without_a_repository_the_commit_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "FOLDER", tmp_path / "docs" / "results")
    (tmp_path / "docs" / "results").mkdir(parents=True)
    assert results.commit() == "unknown"


def test_tables_are_written_under_the_name_of_their_page(checkout: Path) -> None:
    out = checkout / "docs" / "results"
    results.write("compare_with_path", "# Page", {"rows": [1]}, out, page="bdpt_against_path")
    document = json.loads((out / "bdpt_against_path.json").read_text())
    assert document["rows"] == [1]
    assert document["commit"] == git(checkout, "rev-parse", "--short", "HEAD")
    assert (out / "bdpt_against_path.md").read_text() == "# Page\n"


def images(mean: float, sigma: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, sigma, (8, 32, 32, 3))


# 8 × 3072 values of 5 %: the mean is known to 0.03 %, and to 0.3 % with 30 %, so 2 % off is seen; noise of 100 % hides
# 0.6 %. The seeds are fixed.
@pytest.mark.parametrize(
    ("mean", "sigma", "expected"),
    [(1.0, 0.05, "pass"), (1.02, 0.3, "FAIL (mean)"), (1.006, 1.0, "pass, noisy"), (np.nan, 0.1, "FAIL (not finite)")],
)
def test_means_within_half_a_percent_pass(mean: float, sigma: float, expected: str) -> None:
    assert compare_with_path.verdict(block_z_test(images(mean, sigma, 1), images(1.0, sigma, 2), blocks=16)) == expected


def test_a_dark_block_fails() -> None:
    dark = images(1.0, 0.05, 1)
    dark[:, :2, :2] *= 0.8
    assert compare_with_path.verdict(block_z_test(dark, images(1.0, 0.05, 2), blocks=16)) == "FAIL (block)"


def test_the_page_about_bias_has_no_figures_of_efficiency() -> None:
    row = compare_with_path.Row("glass_caustic", 48, 16, 32768, 8192, 1, 1.0, 8, 3.33, 0.9993, 0.0007, 204.0, "pass")
    text = compare_with_path.page([row], Namespace(connections=1, light_ratio=1.0))
    assert "| glass_caustic | 48² | 16 | 32768 / 8192 | 3.33 | 0.9993 ± 0.0007 | 204 | pass |" in text
    assert "efficiency" not in text.lower()
    assert "at commit" in text
