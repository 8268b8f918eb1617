"""Errors against a noisy reference: unbiased, the same rule for all, and honest about their uncertainty."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.renderer.peers.errors import (
    efficiency,
    full_error,
    jackknifed,
    mean_ratio,
    reference_of,
    relative_errors,
)

TRUTH = np.random.default_rng(5).uniform(0.5, 2.0, (32, 32, 3))


def renders(rng: np.random.Generator, count: int, noise: float, scale: float = 1.0) -> np.ndarray:
    return scale * TRUTH + rng.normal(0, noise, (count, *TRUTH.shape))


def expected(noise: float) -> float:
    return float((noise**2 / (TRUTH**2 + 1e-2 * TRUTH.mean() ** 2)).mean())


# The error of images of variance v is the mean of v/(r² + ε·mean²), however noisy the reference is. 24 576 independent
# values: the relative standard error is about 1.2 %, so 5 % fails by chance once in 30 000 runs; the seed is fixed.
@pytest.mark.parametrize("reference_noise", [0.001, 0.05, 0.2])
def test_noise_of_the_reference_does_not_count(reference_noise: float) -> None:
    rng = np.random.default_rng(1)
    reference = reference_of([renders(rng, 8, reference_noise)])
    exact = reference_of([renders(rng, 2, 1e-6)])
    error = full_error(relative_errors(renders(rng, 8, 0.1), reference, exact))
    assert error == pytest.approx(expected(0.1), rel=0.05)


# An image that is 10 % too bright everywhere has the error 0.01·r²/(r² + ε·mean²), a little below 0.01.
def test_bias_counts_in_full() -> None:
    rng = np.random.default_rng(2)
    reference = reference_of([renders(rng, 8, 0.01)])
    error = full_error(relative_errors(renders(rng, 4, 1e-4, scale=1.1), reference))
    assert error == pytest.approx(0.01 * float((TRUTH**2 / (TRUTH**2 + 1e-2 * TRUTH.mean() ** 2)).mean()), rel=0.02)


# Errors 4 : 1 and times 1 : 2 make an efficiency of 2.
def test_efficiency_weighs_error_against_time() -> None:
    ones = np.ones((8, 50))
    found = efficiency(ones, np.full(8, 2.0), 4 * ones, np.full(8, 1.0), full_error)
    assert found.value == pytest.approx(2.0)
    assert found.standard_error == pytest.approx(0.0, abs=1e-12)


# Jackknife of a mean: its standard error is that of the mean, s/√K, here to first order of the logarithm.
def test_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(4).normal(10, 0.5, 12)
    found = jackknifed(lambda kept: float(values[kept].mean()), len(values))
    assert found.value == pytest.approx(values.mean())
    assert found.standard_error == pytest.approx(values.std(ddof=1) / math.sqrt(12), rel=0.02)


# |z| < 4.5 for equal means (by chance once in 150 000 runs; the seed is fixed), and far beyond for 2 % more light.
def test_a_bias_of_the_mean_is_seen() -> None:
    rng = np.random.default_rng(6)
    reference = reference_of([renders(rng, 8, 0.1)])
    assert abs(mean_ratio(renders(rng, 8, 0.1), reference).z) < 4.5
    brighter = mean_ratio(renders(rng, 8, 0.1, scale=1.02), reference)
    assert brighter.value == pytest.approx(1.02, abs=0.003)
    assert brighter.z > 4.5
