"""What pages say of candidates that were trained for equal time, from errors that are made up."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from bench.harness.network_errors import Errors
from bench.trainer import guided_networks, recipe
from bench.trainer.equal_time import Gap, Result, settings_of

UNITS = tuple(bytes([unit]) * 16 for unit in range(32))
TOLD = argparse.Namespace(modifications=64, references=32, reference_spp=16, seconds=3.0, seeds=[0, 1])


def result(name: str, factor: float, own: float = 0.01) -> Result:
    """Errors that are so many times those of all, but for some percent of their own."""
    common = np.random.default_rng(0).uniform(0.5, 1.5, (1, len(UNITS)))
    noise = np.random.default_rng(sum(name.encode())).normal(0, own, (2, len(UNITS)))
    return Result(name, 0.05, 60, 0.02, Errors(factor * common * (1 + noise), UNITS), 0.9)


@pytest.mark.parametrize(
    ("factor", "own", "verdict"), [(1.2, 0.01, "worse"), (0.8, 0.01, "better"), (1.02, 0.5, "not told apart")]
)
def test_a_gap_is_a_share_of_the_others_error_and_its_interval_decides(factor: float, own: float, verdict: str) -> None:
    gap = Gap.of(result("one", factor, own), result("other", 1.0, own))
    assert gap.share == pytest.approx(factor - 1, abs=0.01 if own < 0.1 else 0.3)
    assert gap.low < gap.share < gap.high
    assert np.mean(gap.seeds) == pytest.approx(gap.share)
    assert gap.verdict() == verdict


def test_a_page_of_networks_has_those_that_were_kept_and_those_that_were_not() -> None:
    every = [result(name, 1.0) for name in guided_networks.CANDIDATES]
    lines = guided_networks.page({"room": every}, TOLD).splitlines()
    (kept,) = [line for line in lines if line.startswith("| guided_transport |")]
    assert "| guided +" in kept or "| guided -" in kept
    for name, instead in guided_networks.INSTEAD.items():
        _, row = [line for line in lines if line.startswith(f"| {name} |")]
        assert f"| {instead} " in row
    few = guided_networks.page({"room": [result("OneBounce", 1.0)]}, TOLD)
    assert few.splitlines()[-1].endswith("| – |"), "nothing to compare it with"


def test_a_page_of_settings_compares_each_with_small() -> None:
    every = [result(name, 1.0 if name == recipe.SMALL else 1.2) for name in recipe.CANDIDATES]
    rows = recipe.page({"room": every}, TOLD).splitlines()[-len(every) :]
    assert [row.split(" | ")[-1].rstrip(" |") for row in rows] == ["–", *["worse"] * (len(every) - 1)]


def test_each_setting_changes_what_it_names_and_nothing_else() -> None:
    small = dict(settings_of({}, 0, 100))
    for name, changes in recipe.CANDIDATES.items():
        made = dict(settings_of(changes, 0, 100))
        differ = {key for key in small if made[key] != small[key]}
        assert differ == {"network" if key == "precision" else key for key in changes}, name
    assert settings_of({"learning_rate": "5e-4"}, 0, 100).learning_rate == 5e-4
