"""A film of a camera path: rendered samples, a trained network, and buffers that the renderer makes for it."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.mark.slow
def test_a_trained_network_is_evaluated_and_shows_a_camera_path(photonfarm, tmp_path: Path, small_room: Path) -> None:
    described = ("--modifications", "8", "--views", "1", "--shard-rows", "8", "--train-steps", "20", "--workers", "1")
    made = photonfarm("up", small_room, *described, "--hold-out", "0.4", timeout=300)
    assert made.returncode == 0, made.stderr

    assert photonfarm("store", "merge", "--out", "references").returncode == 0
    asked = ("--references", "references", "--denoiser", "fill-in", "--kept", "4", "--json")
    evaluated = photonfarm("evaluate", *asked)
    assert evaluated.returncode == 0, evaluated.stderr
    found = json.loads(evaluated.stdout)
    assert found == json.loads((tmp_path / "run/evaluation.json").read_text())
    with Image.open(tmp_path / "run/comparison.png") as side_by_side:
        assert side_by_side.width > 3 * 64
    assert [row["predictor"] for row in found["rows"]] == ["light_transport (run)", "fill-in 1/4"]
    assert all(np.isfinite(row["metric_space"]["mse"]["estimate"]["mean"]) for row in found["rows"])

    views = [{"origin": [1.9, 1.6, 1.7], "look_at": [0, 0.6, 0]}, {"origin": [-1.9, 1.6, 1.7], "look_at": [0, 0.6, 0]}]
    (tmp_path / "path.json").write_text(json.dumps({"frames": 3, "views": views}))
    shown = photonfarm("infer", "--camera-path", "path.json", "--out", "film")
    assert shown.returncode == 0, shown.stderr
    with Image.open(tmp_path / "film/path.gif") as gif:
        assert gif.n_frames == 3
    pictures = [np.asarray(Image.open(tmp_path / f"film/frame-000{i}.png")).astype(int) for i in range(3)]
    assert np.abs(pictures[0] - pictures[2]).mean() > 1

    assert photonfarm("buffers", "--scene", "room", "--camera-path", "path.json").returncode == 0
    assert photonfarm("infer", "--buffers", "buffers.npz", "--out", "again").returncode == 0
    again = (tmp_path / "again/frame-0001.png").read_bytes()
    assert again == (tmp_path / "film/frame-0001.png").read_bytes()
    missing = photonfarm("infer", "--orbit", "2", "--modification", "0 0 0 1")
    assert missing.returncode == 3
    assert "44 are required" in missing.stderr
