"""Pages of results say by which command and at which commit they were made."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from bench.harness import results


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


def test_a_footer_names_the_commit_and_whether_more_is_changed_than_results(checkout: Path) -> None:
    head = git(checkout, "rev-parse", "--short", "HEAD")
    (checkout / "docs" / "results" / "cost.md").write_text("# Cost\n")
    assert results.commit() == head
    assert f"at commit {head} (" in results.footer("cost")
    (checkout / "code.py").write_text("a = 2\n")
    assert results.commit().endswith(" with uncommitted changes")


def test_tables_are_written_under_the_name_of_their_page(checkout: Path) -> None:
    out = checkout / "docs" / "results"
    results.write("compare_with_path", "# Page", {"rows": [1]}, out, page="bdpt_against_path")
    document = json.loads((out / "compare_with_path.json").read_text())
    assert document["rows"] == [1]
    assert document["commit"] == git(checkout, "rev-parse", "--short", "HEAD")
    page, signed = (out / "bdpt_against_path.md").read_text().split("\n\n")
    assert page == "# Page"
    assert signed.startswith("Made by `")


def test_a_benchmark_replaces_its_own_part_of_a_page_and_leaves_the_others(tmp_path: Path) -> None:
    for text in ("# Cost\n\nold\n\n## Views\n\nold", "# Rays\n\nmany", "# Cost\n\nnew"):
        results.save("cost", text, {"of": text}, tmp_path, stem=text[2:6].lower())
    assert (tmp_path / "cost.md").read_text() == "# Cost\n\nnew\n\n# Rays\n\nmany\n"
    assert json.loads((tmp_path / "rays.json").read_text()) == {"of": "# Rays\n\nmany"}


@pytest.mark.parametrize(
    ("told", "command"),
    [
        ([], "make bench-compare-with-path"),
        (["--out", "elsewhere"], "make bench-compare-with-path"),
        (["--seeds", "4"], "python -m bench.renderer.compare_with_path --seeds 4"),
    ],
)
def test_a_command_makes_the_page_again(monkeypatch: pytest.MonkeyPatch, told: list[str], command: str) -> None:
    monkeypatch.setattr("sys.argv", ["compare_with_path.py", *told])
    assert results.command("compare_with_path") == command
