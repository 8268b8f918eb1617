"""When two integrators are said to have one mean."""

from __future__ import annotations

import numpy as np
import pytest

from bench.renderer import compare_with_path
from photonfarm.core.statistics import block_z_test


def images(mean: float, sigma: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, sigma, (8, 32, 32, 3))


# 8 × 3072 values of 5 %: the mean is known to 0.03 %, and to 0.3 % with 30 %, so 2 % off is seen; noise of 100 % hides
# 0.6 %. The seeds are fixed.
@pytest.mark.parametrize(
    ("mean", "sigma", "expected"),
    [(1.0, 0.05, "pass"), (1.02, 0.3, "FAIL (mean)"), (1.006, 1.0, "pass, noisy"), (np.nan, 0.1, "FAIL (not finite)")],
)
def test_means_within_half_a_percent_pass(mean: float, sigma: float, expected: str) -> None:
    assert compare_with_path.verdict(block_z_test(images(mean, sigma, 1), images(1.0, sigma, 2), blocks=16)) == expected


def test_a_dark_block_fails() -> None:
    dark = images(1.0, 0.05, 1)
    dark[:, :2, :2] *= 0.8
    assert compare_with_path.verdict(block_z_test(dark, images(1.0, 0.05, 2), blocks=16)) == "FAIL (block)"
