"""Ours beside denoisers that take as long: which error a family has after a time, and what is said of it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments import equal_time
from experiments.equal_time import Placed, interpolate, measure_ratio
from experiments.experiment import Experiment
from experiments.rooms import Room


def placed(milliseconds: float, mse: float) -> Placed:
    return Placed(f"{milliseconds:g} ms", milliseconds, mse * np.array([0.5, 1.0, 1.5, 1.0]))


FAMILY = [placed(100, 0.04), placed(400, 0.01)]


def test_between_two_of_a_family_the_error_follows_a_power_of_the_time() -> None:
    assert measure_ratio(placed(200, 0.02), interpolate(FAMILY, 200))[0] == pytest.approx(1)  # type: ignore[arg-type]


def test_beyond_its_slowest_a_family_has_the_least_error_that_it_reaches() -> None:
    found = interpolate([*FAMILY, placed(500, 0.03)], 900)
    assert found is not None
    assert found.first.milliseconds == 400
    assert measure_ratio(placed(900, 0.005), found)[0] == pytest.approx(0.5)


def test_a_ratio_to_a_family_that_could_use_more_samples_in_that_time_is_marked_as_a_bound() -> None:
    assert equal_time._format_ratio(placed(900, 0.005), FAMILY).startswith("≥ 0.50 (")
    assert equal_time._format_ratio(placed(400, 0.005), FAMILY).startswith("0.50 (")
    assert equal_time._format_ratio(placed(200, 0.01), FAMILY).startswith("0.50 (")


def test_a_family_that_takes_longer_has_no_error_at_that_time() -> None:
    assert interpolate(FAMILY, 99) is None
    assert interpolate([], 99) is None
    assert equal_time._format_ratio(placed(50, 0.1), FAMILY) == "all take longer, from 100 ms"


def test_what_views_share_is_not_in_the_interval() -> None:
    _, low, high = measure_ratio(placed(100, 0.03), interpolate(FAMILY, 100))  # type: ignore[arg-type]
    assert low == pytest.approx(high)
    differing = Placed("other", 100, np.array([0.06, 0.01, 0.02, 0.03]))
    value, low, high = measure_ratio(differing, interpolate(FAMILY, 100))  # type: ignore[arg-type]
    assert low < value < high


def make_room(times: dict[str, tuple[float, float]]) -> Room:
    """A room whose rows have these seconds a frame and errors."""
    rows = {
        name: {
            "frame_seconds": {"total": seconds},
            "mse": {"mean": 0.03 * error, "standard_error": None, "count": 2},
            "mse_of_images": [0.04 * error, 0.02 * error],
        }
        for name, (seconds, error) in times.items()
    }
    return Room(Experiment.load("night-living-room", "small"), {"edit_seconds": 0.5, "rows": rows})


def test_a_family_is_all_ways_to_feed_it_less_those_that_something_quicker_is_better_than() -> None:
    times: dict[str, tuple[float, float]] = {
        "oidn 1/1": (3, 1),
        "oidn-fast 1/1": (1, 2),
        "oidn-fast 2/1": (2, 3),
        "oidn-fast-reflectance 1/1": (4, 0.5),
    }
    times |= {"denoise_1": (5, 1), "denoise_1_reflectance": (6, 0.9), "guided_denoise": (1, 1)}
    room = make_room(times)
    found = {
        called: [each.name for each in equal_time.order_family(room, names)]
        for names, called in equal_time.FAMILIES.items()
    }
    assert found == {
        "denoisers trained on the room": ["denoise_1", "denoise_1_reflectance"],
        "OIDN by albedo": ["oidn-fast 1/1", "oidn 1/1"],
        "OIDN by reflectance": ["oidn-fast-reflectance 1/1"],
        "bdpt": [],
        "path": [],
    }
    rows = equal_time.format_rows([room, make_room({"denoise_1": (1, 2)})]).splitlines()[2:]
    assert rows[0].startswith("| oidn 1/1 | 0.03000 ± 0.127")
    assert rows[0].endswith(" (3500) |  |")
    assert [row.split(" | ")[0][2:] for row in rows] == [name for name in times if " 2" not in name]


def test_ours_stands_beside_the_best_of_all_denoisers_or_beside_the_first_of_them() -> None:
    times = {
        "guided_transport": (1.5, 1),
        "oidn-fast 1/1": (1.4, 4),
        "oidn-fast-reflectance 1/1": (1.5, 2),
        "denoise_1": (2, 1),
    }
    (line,) = equal_time.format_best([make_room(times), make_room({"cnn": (1, 1)})], ["guided_transport"]).splitlines()[
        2:
    ]
    assert line == "| night-living-room | 0.03000, 2000 ms: 0.50 (0.50 … 0.50) |"
    (line,) = equal_time.format_best(
        [make_room({**times, "guided_transport": (1, 1)})], ["guided_transport", "guided"]
    ).splitlines()[2:]
    assert (
        line
        == "| night-living-room | 0.03000, 1500 ms: first, oidn-fast 1/1 comes 400 ms later: 0.25 (0.25 … 0.25) |  |"
    )


def test_rows_of_ours_are_grouped_by_run_whatever_the_steps_and_the_halves() -> None:
    times = {"guided_denoise": (1, 1), "guided_denoise 8/1": (5, 0.2), "guided_denoise-4000": (1, 0.7)}
    times |= {"guided_denoise-4000 8/1": (5, 0.1), "guided_transport": (0.5, 2), "cnn-4000": (0.4, 9)}
    room = make_room({**times, "denoise_1-4000": (2, 0.8), "oidn-reflectance 8/1": (4, 0.4)})
    found = equal_time.group_networks(room, equal_time.OURS)
    assert [*found.values()] == [["guided_transport"], *([run, f"{run} 8/1"] for run in [*found][1:])]
    assert [*found] == ["guided_transport", "guided_denoise", "guided_denoise-4000"]
    assert [*equal_time.group_networks(room, equal_time.NETWORKS)] == ["cnn-4000", *found]
    of_ours = [line.split(" | ")[1] for line in equal_time.format_table([room]).splitlines()[2:]]
    assert of_ours == [each.name for each in equal_time.place_rows(room, [*found, *(f"{run} 8/1" for run in found)])]
    denoisers = next(names for names, called in equal_time.FAMILIES.items() if called.startswith("denoisers"))
    assert [each.name for each in equal_time.order_family(room, denoisers)] == ["denoise_1-4000"]
    assert equal_time.draw_picture([room]).startswith(b"\x89PNG")
    assert equal_time.list_longest([room]) == ["guided_denoise-4000"]
    assert equal_time.list_longest([make_room({"guided_transport": (1, 1)})]) == ["guided_transport"]


def test_a_name_without_an_experiment_or_a_report_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, code, said in (("kitchn", 3, "no such experiment"), ("static-kitchen", 7, "run.py static-kitchen")):
        monkeypatch.setattr(sys, "argv", ["equal_time.py", name, "--work", str(tmp_path)])
        assert equal_time.main() == code
        assert said in capsys.readouterr().err
