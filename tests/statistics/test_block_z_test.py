from __future__ import annotations

import numpy as np
import pytest

from photonfarm.core.statistics import block_z_test, mean_ratio


def noise(seed: int, scale: float = 1.0, k: int = 8) -> np.ndarray:
    return scale * np.random.default_rng(seed).gamma(2, 1, (k, 32, 32, 3))


def test_equal_means_pass() -> None:
    results = [block_z_test(noise(2 * s), noise(2 * s + 1)) for s in range(20)]
    assert sum(r.passed for r in results) >= 19
    assert all(abs(r.mean_ratio - 1) < 5 * r.mean_ratio_standard_error for r in results)


def test_a_bias_in_one_block_is_found() -> None:
    biased = noise(0)
    biased[:, :2, 30:] += 6
    result = block_z_test(biased, noise(1))
    assert not result.passed
    assert np.unravel_index(np.abs(result.z).argmax(), result.z.shape) == (0, 15)


def test_equal_constant_images_pass_although_their_variance_is_zero() -> None:
    ones = np.ones((2, 8, 8, 3))
    assert block_z_test(ones, ones).passed
    assert not block_z_test(ones, ones * 1.01).passed


def test_the_rounding_of_a_bright_block_without_variance_is_no_bias() -> None:
    a, b = noise(0), noise(1)
    a[:, :2, :2], b[:, :2, :2] = 9.60001024, 9.59995619  # a light seen directly, summed in float32 in two ways
    assert block_z_test(a, b).passed


def test_images_that_are_not_finite_fail() -> None:
    broken = noise(0)
    broken[0, 0, 0, 0] = np.inf
    with np.errstate(invalid="ignore"):
        assert not block_z_test(broken, noise(1)).passed


def test_sizes_that_blocks_do_not_divide_use_every_pixel() -> None:
    result = block_z_test(noise(0)[:, :31, :29], noise(1)[:, :31, :29], blocks=7)
    assert result.z.shape == (7, 7)


def test_single_images_are_refused() -> None:
    with pytest.raises(ValueError, match="K, L"):
        block_z_test(noise(0, k=1), noise(1))


def test_the_mean_ratio_of_black_images_is_not_a_number() -> None:
    assert np.isnan(mean_ratio(noise(0), np.zeros((2, 32, 32, 3)))[0])
