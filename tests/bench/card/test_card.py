"""All that `make bench-card` measures, run to its end on whatever renders here, and what it does when parts fail."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.card import trained, values
from bench.card.__main__ import Part, describe_run, list_parts, measure_missing, page, read_kept
from bench.harness.results import ROOT
from photonfarm.scene.modification import sample_modification
from photonfarm.store import SceneReader


def run_card(out: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "bench.card", "--size", "32", "--out", str(out), *arguments]
    told = {**os.environ, "PHOTONFARM_SCENES": str(out)}  # no room but those that are built in, wherever this runs
    return subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True, check=True).stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_part_runs_to_its_end_and_is_not_measured_again(tmp_path: Path) -> None:
    run_card(tmp_path, "--minutes", "24")
    found = {part.name: json.loads((tmp_path / "parts" / f"{part.name}.json").read_text()) for part in list_parts()}
    skipped = {name for name, of in found.items() if of.get("missing", "").startswith("skipped")}
    assert not {name: of["missing"] for name, of in found.items() if "missing" in of and name not in skipped}
    assert all("-veach-ajar" in name or "-living-room-2" in name or name == "optix-room" for name in skipped)
    assert found["values-room"]["verdict"] == found["values-cornell"]["verdict"] == "right"
    assert found["networks-cnn"]["step_ms"] > found["networks-cnn"]["frame_ms"] > 0
    assert found["worker-room"]["samples_per_s"] > 0 < found["worker-room"]["busy"]
    assert set(found["equal_time-room"]["rows"]) >= {"path", "bdpt (1, 1)", "oidn-fast", "oidn-reflectance"}
    spec = trained.training_spec("room", 32)
    reader = SceneReader(tmp_path / f"store-{spec.scene_id}", spec.scene_id)
    seen = set(reader.modification_keys(reader.refresh().tolist()))
    referred, learned = (sample_modification(spec, seed, 0).key(spec.radiance_id) for seed in (0, 1))
    assert learned in seen, "a key of a configuration that is trained on"
    assert referred not in seen
    for network in trained.NETWORKS:
        of = found[f"trained-room-{network}"]
        assert of["steps"] > 0 < of["trained_s"] <= 2 * 360 * trained.TRAINED
        assert of["oidn"][0] > 0 < of["ms"]
    assert found["trained-room-guided_denoise"]["mse"] < 0.01, "a filtered half at the least"
    text = (tmp_path / "card.md").read_text()
    assert "not begun" not in text
    assert "| bdpt (4, 0.125), guided |" in text
    begun = re.findall(r": (\S+)\n", run_card(tmp_path, "--minutes", "24"))
    assert set(begun) == skipped


@pytest.mark.slow
def test_a_part_that_takes_too_long_does_not_lose_the_others(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("PHOTONFARM_SCENES", str(tmp_path))
    parts, run = [Part("equal_time", "room"), Part("values", "veach-ajar")], describe_run(32)
    (tmp_path / "parts").mkdir()
    measure_missing(parts, run, tmp_path, minutes=0.8)  # 12 s for each part: references alone take 15
    assert [read_kept(part, run, tmp_path)["missing"].split(":")[0] for part in parts] == ["failed", "skipped"]
    text = page([*parts, Part("rates", "room")], run, tmp_path)
    assert "- room: failed: took longer than 12 s" in text
    assert "- veach-ajar: skipped: " in text
    assert "- room: not begun" in text


def test_values_are_right_only_near_the_references() -> None:
    wanted = json.loads(values.REFERENCES.read_text())["room"]
    assert values.compare(wanted, wanted)["verdict"] == "right"
    brighter = {**wanted, "halves": list(1.1 * np.array(wanted["halves"]))}
    assert values.compare(brighter, wanted)["verdict"] == "WRONG"
    moved = {**wanted, "inputs": {**wanted["inputs"], "depth": list(1.02 * np.array(wanted["inputs"]["depth"]))}}
    assert values.compare(moved, wanted)["verdict"] == "WRONG"
