"""Exponents of known growths, and what a page on them says; `make bench-scale` alone measures."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np
import pytest

from bench.farm import scale
from bench.farm.scale_costs import COSTS, TARGETS, first_to_break, grown
from bench.farm.scale_page import page
from bench.harness.growth import Growth

SIZES = (1e4, 1e5, 1e6)


@pytest.mark.parametrize(("constant", "factor", "exponent"), [(0, 3, 1), (0, 2e-3, 2), (50, 1e-3, 1), (7, 1e-4, 1.5)])
def test_a_growth_is_found_with_its_constant(constant: float, factor: float, exponent: float) -> None:
    sizes = np.geomspace(1e3, 1e6, 7)
    costs = constant + factor * sizes**exponent
    found = Growth.of(sizes.tolist(), costs.tolist())
    assert found.exponent == pytest.approx(exponent, abs=0.03)
    assert found.at(1e7) == pytest.approx(constant + factor * 1e7**exponent, rel=0.2)
    assert found.size_of(found.at(1e7)) == pytest.approx(1e7, rel=1e-6)


def test_the_interval_holds_the_exponent_in_about_95_of_100_cases() -> None:
    random, sizes = np.random.default_rng(1), np.geomspace(1e3, 1e6, 6)
    inside = 0
    for _ in range(300):
        found = Growth.of(sizes.tolist(), (sizes * np.exp(0.2 * random.standard_normal(6))).tolist())
        assert found.reach is not None
        inside += abs(found.exponent - 1) <= found.reach
    assert 0.8 <= inside / 300 <= 0.995, "the constant is fitted as well, and not in the interval"


def test_what_does_not_grow_is_constant_and_never_ends() -> None:
    found = Growth.of(SIZES, (3.0, 3.3, 2.9))
    assert found.at(1e12) == pytest.approx(3.07, abs=0.01)
    assert found.size_of(10.0) == math.inf
    assert found.size_of(1.0) == 0.0
    with pytest.raises(ValueError, match="at least 3"):
        Growth.of(SIZES[:2], (1.0, 2.0))


def measured(exponent: float, at_target: float) -> dict[str, dict[float, dict[str, float]]]:
    """A store's first and later plans: the first grows so, to so many times its limit; the later ones linearly."""
    first, later = (next(cost for cost in COSTS if cost.step == step) for step in ("plan", "plan_more"))
    target = TARGETS["samples"]
    return {
        "plan": {n: {first.name: at_target * first.limit * (n / target) ** exponent} for n in SIZES},
        "plan_more": {n: {later.name: 2 * later.limit * n / target} for n in SIZES},
    }


def test_what_ends_first_is_told_first() -> None:
    found = grown(measured(exponent=2, at_target=100))
    assert [each.cost.step for each in first_to_break(found)] == ["plan", "plan_more"]
    assert [round(each.room, 2) for each in first_to_break(found)] == [0.1, 0.5]
    below = grown(measured(exponent=2, at_target=0.5))
    assert [each.cost.step for each in first_to_break(below)] == ["plan_more"]


def test_the_page_sets_what_was_before_beside_what_is_now(tmp_path: Path) -> None:
    now = grown(measured(exponent=1, at_target=0.5))
    file = tmp_path / "before.json"
    file.write_text(
        json.dumps({"measured": measured(exponent=2, at_target=100), "commit": "abc with uncommitted changes"})
    )
    earlier, commit = scale.read(file)
    text = page(now, {each.cost: each for each in grown(earlier)}, commit)
    assert "at commit abc, measured" in text
    assert "1.00 ± 0.00 (2.00 ± 0.00)" in text
    assert "never" not in text.split("## Files")[0]
    assert "| 32 | 312,500 |" in text


def test_what_is_not_measured_again_is_kept_from_the_first_file_that_has_it(tmp_path: Path) -> None:
    def file(commit: str, *steps: str) -> Path:
        measured = {step: {"4": {"from": commit}} for step in steps}
        document = {"measured": measured, "commit": commit, "kept_from_commits": {"plan": "ghi"}}
        (tmp_path / commit).write_text(json.dumps(document))
        return tmp_path / commit

    files = [file("abc", "workers", "bucket news"), file("def", "bucket news", "plan", "plans")]
    options = argparse.Namespace(kept=files, samples=[], bucket=[], plans=[4, 16], workers=[])
    found, commits = scale.kept(options)
    assert commits == {"workers": "abc", "bucket news": "abc", "plan": "ghi"}
    assert found == {
        "workers": {4.0: {"from": "abc"}}, "bucket news": {4.0: {"from": "abc"}}, "plan": {4.0: {"from": "def"}}
    }  # fmt: skip
    assert "Measured earlier: workers, bucket news at abc; plan at ghi." in page([], {}, "", commits)
