"""The page, the plots, calibration, and what is kept of a run that was cut."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.renderer import render
from bench.renderer.peers import page, scoring
from bench.renderer.peers.chosen import given
from bench.renderer.peers.errors import reference_of
from bench.renderer.peers.measure import MeasuredMethod
from bench.renderer.peers.methods import Shot, calibrate
from bench.renderer.peers.plans import BUDGETS
from photonfarm.core.files import write_whole

TRUTH = np.ones((16, 16, 3))


class Clockwork:
    """A method whose images cost 10 ms and 1 ms a sample, and whose variance is 1/spp; spp in multiples of `grid`."""

    def __init__(self, noise: float = 1.0, fixed_s: float = 0.01, sample_s: float = 0.001, grid: int = 1) -> None:
        self.noise, self.fixed_s, self.sample_s, self.grid, self.calls = noise, fixed_s, sample_s, grid, 0

    def render(self, seed: int, spp: int) -> Shot:
        self.calls += 1
        compiling = 1.5 if self.calls == 1 else 0.0
        noise = np.random.default_rng(seed).normal(0, self.noise / np.sqrt(spp), TRUTH.shape)
        seconds = self.fixed_s + spp * self.sample_s
        return Shot((TRUTH + noise).astype(np.float32), seconds + compiling, seconds)

    def possible(self, spp: float) -> int:
        return max(self.grid, round(spp / self.grid) * self.grid)

    def close(self) -> None:
        pass


KEY = {
    "clock": "wall",
    "seconds": 0.5,
    "threads": 1,
    "size": 16,
    "seeds": 8,
    "versions": {"mitsuba": "3.9.1"},
    "pilot_seconds": 20.0,
    "chosen": "",
}


def measured(method: Clockwork, base: int, seeds: int = 8) -> MeasuredMethod:
    calibration = calibrate(method, tuple(share * 0.5 for share in BUDGETS), "wall")
    shots = [[method.render(base + 100 * b + k, spp) for k in range(seeds)] for b, spp in enumerate(calibration.spp)]
    return MeasuredMethod(calibration, shots)


def result_of(name: str = "cornell", chosen_noise: float = 0.5) -> dict[str, Any]:
    noises = {"path": 1.0, "path-multijitter": 0.8, "ptracer": 0.7, "bdpt": 0.5, "chosen": chosen_noise}
    sets = {method: measured(Clockwork(noise), 1000 * k) for k, (method, noise) in enumerate(noises.items(), 1)}
    reference = reference_of([np.stack([Clockwork().render(k, 100_000).image for k in range(8)])])
    references = dict.fromkeys([*sets, "common"], reference)
    return {
        "line": name,
        "scene": name,
        "max_depth": 8,
        "note": "",
        "reference": "test",
        "chosen": {"connections": 4, "light_ratio": 0.25, "pilot_wall_s": 20.0, "why": ""},
        "commit": "0123abc",
        "absent": {"pyluxcore": "not expressible: a test"},
        "differences": [],
        "rows": scoring.rows(sets, references, "wall"),
        "gains": scoring.gains("chosen", sets, references, "wall"),
        "curves": scoring.curves(sets, references, "wall"),
    }


def test_calibration_meets_the_time_budget_and_tells_compilation_apart() -> None:
    found = calibrate(Clockwork(), (0.125, 0.5), "wall")
    assert found.spp[1] == pytest.approx(490, rel=0.15)
    assert found.spp[0] == pytest.approx(115, rel=0.05)
    assert found.compile_s == pytest.approx(1.5)


# Grids of 300 samples: 0.5 s would take 490, the nearest is 600, which takes 0.61 s.
def test_a_method_that_takes_few_numbers_of_samples_gets_the_nearest() -> None:
    assert calibrate(Clockwork(grid=300), (0.125, 0.5), "wall").spp == (300, 600)


# Half the noise at the same time: a quarter of the error, efficiency 4. 8 × 768 values: 2.6 % standard error; 15 % is
# beyond 5 of them, and the seeds are fixed.
def test_half_the_noise_at_equal_time_is_four_times_as_efficient() -> None:
    rows = result_of()["rows"]
    assert rows["bdpt"]["efficiency_full"]["value"] == pytest.approx(4.0, rel=0.15)
    assert rows["path"]["efficiency_full"]["value"] == pytest.approx(1.0)


def test_the_page_has_a_figure_in_every_cell() -> None:
    assert "nan" not in page.page([result_of()], KEY, "a machine")


# ptracer's noise is 0.7, so its efficiency is above that of multijitter, 0.8; a mean that is off takes it out.
def test_the_best_peer_is_the_best_whose_mean_is_not_off() -> None:
    result = result_of()
    assert page.best_peer(result, "full") == "ptracer"
    result["rows"]["ptracer"]["mean_ratio"] = {"value": 0.8, "standard_error": 0.01, "z": -9.0}
    assert page.best_peer(result, "full") == "path-multijitter"
    assert "(`path`, multijitter) |" in page.page([result], KEY, "a machine")


def test_a_choice_that_loses_to_fixed_settings_is_told() -> None:
    told = "In cornell *chosen*, (4, 0.25), is worse than `bdpt` (1, 1)"
    assert told in page.page([result_of(chosen_noise=0.6)], KEY, "a machine")
    better = page.page([result_of(chosen_noise=0.4)], KEY, "a machine")
    assert told not in better
    assert "No fixed setting of `bdpt` beats *chosen*" in better


@pytest.mark.parametrize(
    ("method", "ratio", "z", "expected"),
    [
        ("ptracer", 0.9, -20.0, " ‡"),
        ("ptracer", 0.9, -2.0, ""),
        ("path", 1.0005, 5.0, ""),
        ("pyluxcore", 1.14, 9.0, " §"),
        ("pyluxcore", 1.03, 9.0, ""),
    ],
)
def test_a_doubtful_mean_is_marked(method: str, ratio: float, z: float, expected: str) -> None:
    row = {"finite": True, "mean_ratio": {"value": ratio, "standard_error": 0.01, "z": z}}
    assert page.mark(method, row) == expected


def test_a_result_counts_only_for_equal_settings(tmp_path: Path) -> None:
    key = {"seconds": 1.0, "methods": ["path"]}
    assert render.kept(tmp_path, "cove", key) is None
    write_whole(tmp_path / "cove.json", json.dumps({"settings": key, "rows": {}}))
    assert render.kept(tmp_path, "cove", json.loads(json.dumps(key))) is not None
    assert render.kept(tmp_path, "cove", {**key, "seconds": 2.0}) is None
    (tmp_path / "cove.json").write_text('{"settings": ')
    assert render.kept(tmp_path, "cove", key) is None


def test_given_settings_are_checked() -> None:
    assert given("2,0.5").parameters() == {"connections": 2, "light_ratio": 0.5}
    assert given("2,0.5,guided").parameters() == {"connections": 2, "light_ratio": 0.5, "guided_light": True}
    with pytest.raises(ValueError, match=r"CONNECTIONS,LIGHT_RATIO"):
        given("many")
