"""The main job, small: submitted, rendered by two workers, trained on meanwhile, shown and reported."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_whole_farm_renders_trains_and_reports(photonfarm, tmp_path: Path, small_room: Path) -> None:
    arguments = ("up", small_room, "--modifications", "16", "--views", "2", "--shard-rows", "4", "--train-steps", "40")
    result = photonfarm(*arguments, timeout=400)
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["dataset"]["samples_complete"] == 32
    assert report["dataset"]["core_seconds_per_sample"] > 0
    (run,) = report["runs"]
    assert run["steps"] == 40
    assert run["curve"][-1]["error"] < run["curve"][0]["error"]
    for page in ("out/preview.html", "out/report.html"):
        text = (tmp_path / page).read_text()
        assert text.count("data:image/png;base64,") >= 6
        assert not re.search(r'(src|href)="(?!data:|#)', text)

    markers = {p.name: p.read_bytes() for p in tmp_path.glob("store/scenes/*/committed/*.json")}
    again = photonfarm(*arguments, timeout=400)
    assert again.returncode == 0, again.stderr
    assert {p.name: p.read_bytes() for p in tmp_path.glob("store/scenes/*/committed/*.json")} == markers

    _read_as_the_readme_does(tmp_path)


def _read_as_the_readme_does(folder: Path) -> None:
    """The reading example of README.md, run as it stands, reads committed samples with plain zarr-python."""
    (example,) = re.findall(r"```python\n(from pathlib import Path.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    check = "\nimport sys, numpy\nassert numpy.isfinite(half_a).all() and not numpy.array_equal(half_a, half_b)\n"
    check += "assert not any(name.startswith('photonfarm') for name in sys.modules)\n"
    subprocess.run([sys.executable, "-c", example + check], cwd=folder, check=True)
