"""The page, the plots, calibration, and what is kept of a run that was cut."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import render
from render_peers import page, scoring
from render_peers.chosen import given
from render_peers.errors import reference_of
from render_peers.measure import Measured
from render_peers.methods import Shot, calibrate
from render_peers.plans import BUDGETS, PLANS, estimated_seconds

TRUTH = np.ones((16, 16, 3))


class Clockwork:
    """A method whose images cost 10 ms and 1 ms a sample, and whose variance is 1/spp."""

    def __init__(self, noise: float = 1.0, fixed_s: float = 0.01, sample_s: float = 0.001) -> None:
        self.noise, self.fixed_s, self.sample_s, self.calls = noise, fixed_s, sample_s, 0

    def render(self, seed: int, spp: int) -> Shot:
        self.calls += 1
        compiling = 1.5 if self.calls == 1 else 0.0
        noise = np.random.default_rng(seed).normal(0, self.noise / np.sqrt(spp), TRUTH.shape)
        seconds = self.fixed_s + spp * self.sample_s
        return Shot((TRUTH + noise).astype(np.float32), seconds + compiling, seconds)

    def close(self) -> None:
        pass


def measured(method: Clockwork, base: int, seeds: int = 8) -> Measured:
    calibration = calibrate(method, tuple(share * 0.5 for share in BUDGETS), "wall")
    shots = [[method.render(base + 100 * b + k, spp) for k in range(seeds)] for b, spp in enumerate(calibration.spp)]
    return Measured(calibration, shots)


def result_of(name: str = "cornell") -> dict[str, Any]:
    sets = {"path": measured(Clockwork(), 1000), "bdpt": measured(Clockwork(noise=0.5), 2000)}
    reference = reference_of([np.stack([Clockwork().render(k, 100_000).image for k in range(8)])])
    references = dict.fromkeys([*sets, "common"], reference)
    return {
        "line": name, "scene": name, "max_depth": 8, "note": "", "reference": "test", "chosen": None,
        "absent": {"pyluxcore": "not expressible: a test"}, "differences": [],
        "rows": scoring.rows(sets, references, "wall"), "curves": scoring.curves(sets, references, "wall"),
    }  # fmt: skip


def test_calibration_meets_the_time_budget_and_tells_compilation_apart() -> None:
    found = calibrate(Clockwork(), (0.125, 0.5), "wall")
    assert found.spp[1] == pytest.approx(490, rel=0.15)
    assert found.spp[0] == pytest.approx(115, rel=0.05)
    assert found.compile_s == pytest.approx(1.5)


def test_a_method_too_slow_for_the_budget_gets_one_sample() -> None:
    assert calibrate(Clockwork(sample_s=3.0), (0.1, 1.0), "wall").spp == (1, 1)


# Half the noise at the same time: a quarter of the error, efficiency 4. 8 × 768 values: 2.6 % standard error; 15 % is
# beyond 5 of them, and the seeds are fixed.
def test_half_the_noise_at_equal_time_is_four_times_as_efficient() -> None:
    rows = result_of()["rows"]
    assert rows["bdpt"]["efficiency_full"]["value"] == pytest.approx(4.0, rel=0.15)
    assert rows["path"]["efficiency_full"]["value"] == pytest.approx(1.0)


def test_the_curve_ends_with_averages_of_two_and_four_images() -> None:
    points = result_of()["curves"]["path"]
    assert [point["averaged"] for point in points] == [1, 1, 1, 2, 4]
    errors = [point["full"] for point in points]
    assert errors == sorted(errors, reverse=True)
    assert points[-1]["seconds"] == pytest.approx(4 * points[2]["seconds"])


def test_the_page_names_every_scene_method_and_reason() -> None:
    key = {"clock": "wall", "seconds": 0.5, "threads": 1, "size": 16, "seeds": 8, "versions": {"mitsuba": "3.9.1"}}
    text = page.page([result_of()], key, "a machine")
    assert "make bench-render" in text
    assert "not expressible: a test" in text
    assert "![relMSE against time](render/cornell.png)" in text
    assert "| `bdpt` (1, 1) |" in text
    assert not [line for line in text.splitlines() if "nan" in line]


@pytest.mark.parametrize(
    ("method", "ratio", "z", "expected"),
    [("ptracer", 0.9, -20.0, " ‡"), ("ptracer", 0.9, -2.0, ""), ("path", 1.0005, 5.0, ""),
     ("pyluxcore", 1.14, 9.0, " §"), ("pyluxcore", 1.03, 9.0, "")],
)  # fmt: skip
def test_a_doubtful_mean_is_marked(method: str, ratio: float, z: float, expected: str) -> None:
    row = {"finite": True, "mean_ratio": {"value": ratio, "standard_error": 0.01, "z": z}}
    assert page.mark(method, row) == expected


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(123.456, 3, "123"), (1234.0, 1, "1000"), (0.01234, 3, "0.0123"), (1.0, 3, "1.00"), (0.000012345, 3, "1.23e-05")],
)
def test_numbers_have_significant_digits(value: float, digits: int, text: str) -> None:
    assert page.number(value, digits) == text


def test_a_plot_is_written_for_a_scene(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: make bench-render installs it")
    from render_peers import plot

    plot.save(result_of(), tmp_path / "render" / "cornell.png", "wall")
    assert (tmp_path / "render" / "cornell.png").read_bytes().startswith(b"\x89PNG")


def test_a_result_counts_only_for_equal_settings(tmp_path: Path) -> None:
    key = {"seconds": 1.0, "methods": ["path"]}
    assert render.kept(tmp_path, "cove", key) is None
    render.store(tmp_path / "cove.json", {"settings": key, "rows": {}})
    assert render.kept(tmp_path, "cove", json.loads(json.dumps(key))) is not None
    assert render.kept(tmp_path, "cove", {**key, "seconds": 2.0}) is None
    (tmp_path / "cove.json").write_text('{"settings": ')
    assert render.kept(tmp_path, "cove", key) is None


def test_the_default_run_is_planned_for_less_than_forty_minutes() -> None:
    assert estimated_seconds(len(PLANS), 5, 8, 1.0, 16, pilot=True) < 40 * 60


def test_given_settings_are_checked() -> None:
    assert given("2,0.5").parameters() == {"connections": 2, "light_ratio": 0.5}
    with pytest.raises(ValueError, match=r"CONNECTIONS,LIGHT_RATIO"):
        given("many")
