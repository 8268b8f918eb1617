"""The main job, small: rendered by two workers, trained on meanwhile, reported; evaluated, and filmed."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from photonfarm.trainer.runs import checkpoint

ROOT = Path(__file__).parents[2]
UP = ("up", "small.toml", "--modifications", "16", "--views", "2", "--shard-rows", "4", "--train-steps", "40")
UP = (*UP, "--preset", "small", "--architecture", "guided_transport", "--set", "batch=3", "--also", "guided", "20")

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, photonfarm_in, small_room_in) -> Path:
    """The folder where the farm was at work."""
    folder = tmp_path_factory.mktemp("farm")
    small_room_in(folder)
    result = photonfarm_in(folder)(*UP, timeout=400)
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def photonfarm(folder: Path, photonfarm_in) -> Command:
    """The command line, there."""
    return photonfarm_in(folder)


def test_the_farm_renders_trains_and_reports(folder: Path) -> None:
    report = json.loads((folder / "out/report.json").read_text())
    assert report["dataset"]["samples_complete"] == 32
    assert report["dataset"]["core_seconds_per_sample"] > 0
    run, also = report["runs"]
    assert (run["steps"], also["steps"], also["architecture"]) == (40, 20, "guided")
    assert (folder / "run-guided/checkpoint.safetensors").exists()
    assert json.loads((folder / "run/settings.json").read_text())["batch"] == 3
    assert [run["curve"][end]["step"] for end in (0, -1)] == [0, 40]  # the first is of the few samples there were then
    assert run["curve"][-1]["error"] < 0.1 * report["mean_colour"]
    for page in ("out/preview.html", "out/report.html"):
        text = (folder / page).read_text()
        assert text.count("data:image/png;base64,") >= 6
        assert not re.search(r'(src|href)="(?!data:|#)', text)


def test_the_same_again_renders_nothing_and_trains_nothing(photonfarm: Command, folder: Path) -> None:
    def markers() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in folder.glob("store/scenes/*/committed/*.json")}

    def network() -> dict[str, bytes]:
        state = checkpoint.load(folder / "run/checkpoint.safetensors")["network"]
        return {name: values.numpy().tobytes() for name, values in state.items()}

    def records() -> list[dict[str, Any]]:
        return [json.loads(line) for line in (folder / "run/metrics.jsonl").read_text().splitlines()]

    (folder / "photonfarm.toml").write_text("[report]\nuntimed = true\n")  # its report may cost less
    before, trained, told = markers(), network(), records()
    again = photonfarm(*UP, "--workers", "1", "--no-web")  # as there is nothing to render
    assert again.returncode == 0, again.stderr
    assert markers() == before
    assert network() == trained
    assert records() == told, "a run that has ended stays as it is"


def test_the_reading_example_of_the_format_reads_committed_samples_with_plain_zarr(folder: Path) -> None:
    page = (ROOT / "docs/store-format.md").read_text()
    (example,) = re.findall(r"```python\n(import json.*?)```", page, re.DOTALL)
    check = "\nimport sys, numpy\nassert numpy.isfinite(half_a).all() and not numpy.array_equal(half_a, half_b)\n"
    check += "assert not any(name.startswith('photonfarm') for name in sys.modules)\n"
    subprocess.run([sys.executable, "-c", example + check], cwd=folder, check=True)


def test_the_network_is_evaluated_beside_a_denoiser(photonfarm: Command, folder: Path) -> None:
    assert photonfarm("store", "merge", "--out", "references").returncode == 0
    asked = ("--references", "references", "--denoiser", "fill-in", "--kept", "4", "--samples", "2", "--json")
    evaluated = photonfarm("evaluate", *asked)
    assert evaluated.returncode == 0, evaluated.stderr
    found = json.loads(evaluated.stdout)
    assert found == json.loads((folder / "run/evaluation.json").read_text())
    with Image.open(folder / "run/comparison.png") as side_by_side:
        assert side_by_side.width > 3 * 64
    assert [row["predictor"] for row in found["rows"]] == ["guided_transport (run)", "fill-in 1/4"]
    assert all(np.isfinite(row["metric_space"]["mse"]["estimate"]["mean"]) for row in found["rows"])


def test_the_network_shows_a_camera_path_and_buffers_that_were_made_before_alike(
    photonfarm: Command, folder: Path
) -> None:
    views = [{"origin": [1.9, 1.6, 1.7], "look_at": [0, 0.6, 0]}, {"origin": [-1.9, 1.6, 1.7], "look_at": [0, 0.6, 0]}]
    (folder / "path.json").write_text(json.dumps({"frames": 2, "views": views}))
    shown = photonfarm("infer", "--camera-path", "path.json", "--out", "film")
    assert shown.returncode == 0, shown.stderr
    with Image.open(folder / "film/path.gif") as gif:
        assert gif.n_frames == 2
    pictures = [np.asarray(Image.open(folder / f"film/frame-000{i}.png")).astype(int) for i in range(2)]
    assert np.abs(pictures[0] - pictures[1]).mean() > 1

    assert photonfarm("buffers", "--scene", "room", "--camera-path", "path.json").returncode == 0
    assert photonfarm("infer", "--buffers", "buffers.npz", "--out", "again").returncode == 0
    assert (folder / "again/frame-0001.png").read_bytes() == (folder / "film/frame-0001.png").read_bytes()
