"""The judgement can fail: errors that hard scenes are there to find are found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.stability import runner
from tests.stability.rows import SCENES
from tests.stability.runner import SceneOutcome, compare, run
from tests.stability.scenes.case import FIRST, QUICK, BdptSettings, rendered


def scene(label: str) -> Any:
    return next(scene for scene in SCENES if scene.label == label)


def only(wrong: Any, **options: Any) -> SceneOutcome:
    (outcome,) = run(wrong, quick=True, settings=[FIRST], **options)
    return outcome


def noisy(mean: float, sigma: float, seed: int, renders: int = 12) -> Any:
    return np.random.default_rng(seed).normal(mean, sigma, (renders, 16, 16, 3))


def test_a_bias_of_one_percent_is_found_against_a_known_image() -> None:
    truth = np.ones((1, 16, 16, 3))
    assert compare(noisy(1.0, 0.05, 1), truth, 1).passed
    assert not compare(noisy(1.01, 0.05, 1), truth, 1).passed


def test_a_dark_block_is_found_between_renders() -> None:
    a, b = noisy(1.0, 0.1, 1), noisy(1.0, 0.1, 2)
    assert compare(a, b, 4).passed
    a[:, :4, :4] *= 0.9
    assert not compare(a, b, 4).passed


def test_differences_of_rounding_pass() -> None:
    assert compare(np.full((12, 8, 8, 3), 1.0002), np.ones((1, 8, 8, 3)), 4).passed
    assert not compare(np.full((12, 8, 8, 3), 1.002), np.ones((1, 8, 8, 3)), 4).passed


def test_one_lost_bounce_fails_a_known_scene() -> None:
    result = only(replace(scene("01-shining-sphere-depth-3"), max_depth=2)).result
    assert result.verdict == "FAIL"
    assert "|z|" in result.faults[0]
    assert "--only 01-shining-sphere-depth-3 --settings 1,1 --seed 0 --quick" in result.command


def test_one_lost_bounce_fails_a_scene_with_a_rendered_truth() -> None:
    shorter = rendered("path", "`path`, one edge short", max_depth=5)
    assert only(replace(scene("11-cove"), truth=shorter)).result.verdict == "FAIL"


def test_a_caustic_that_path_misses_fails_against_path() -> None:
    assert only(replace(scene("14-point-caustic"), truth=rendered("path", "`path`"))).result.verdict == "FAIL"


def test_a_test_that_is_too_noisy_to_fail_does_not_pass() -> None:
    noisy_scene = replace(scene("11-cove"), quick=replace(QUICK, seeds=2, spp=1, truth_spp=1))
    assert any("too noisy" in fault for fault in only(noisy_scene).result.faults)


def test_spikes_fail_where_a_row_bounds_them() -> None:
    spiky = replace(scene("02-point-light-in-sphere"), max_over_mean=1.01)
    assert any("brightest" in fault for fault in only(spiky).result.faults)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_counted_and_fails(value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    images = np.full((12, 16, 16, 3), 0.37)
    images[3, 5, 7, 1] = value
    monkeypatch.setattr(runner, "render", lambda *_: images)
    result = only(scene("05-empty")).result
    assert result.not_finite == 1
    assert result.faults == ("1 values are not finite",)


def test_a_black_image_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "render", lambda *_: np.zeros((12, 16, 16, 3), np.float32))
    assert only(scene("05-empty")).result.verdict == "FAIL"


def test_settings_that_are_not_complete_are_not_tried() -> None:
    assert list(run(scene("14-point-caustic"), quick=True, settings=[BdptSettings(0, 0.0)])) == []
