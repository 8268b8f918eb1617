"""Metrics of pairs of images: the metric space, MSE, MSSIM, FLIP, intervals."""

import math

import numpy as np
import pytest
import torch
from flip_evaluator import evaluate
from numpy.typing import NDArray
from scipy import stats

from photonfarm.trainer.metrics.image_metrics import (
    CHUNK,
    PerImage,
    confidence_interval,
    flip,
    measure_images,
    metric_space,
    mse,
    mssim,
    t_975,
)


def _pictures(count: int, size: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Smooth exposed radiance with a few lamps, (count, *size, 3)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : size[0], 0 : size[1]] / 10
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(0, 3, (count * 3, 3))]
    images = np.exp(np.stack(waves)).reshape(count, 3, *size).transpose(0, 2, 3, 1) / 2
    images[:, ::7, ::9] *= 20
    return images.astype(np.float32)


def _noisy(images: NDArray[np.float32], strength: float, seed: int) -> NDArray[np.float32]:
    factor = np.random.default_rng(seed).gamma(1 / strength**2, strength**2, images.shape)
    return (images * factor).astype(np.float32)


# ------------------------------------------------------------------------------------------------------ metric space


def test_the_metric_space_is_clipped_exposed_radiance_to_the_power_of_1_over_2_2() -> None:
    exposed = np.array([-1.0, 0.0, 0.25, 1.0, 7.0, np.inf], np.float32)
    shown = metric_space(exposed.reshape(1, 1, 2, 3))
    assert shown.dtype == torch.float32
    assert torch.allclose(shown.flatten(), torch.tensor([0, 0, 0.25 ** (1 / 2.2), 1, 1, 1]))


@pytest.mark.parametrize("shape", [(4, 4, 3), (1, 4, 4, 4), (1, 2, 4, 4, 3)])
def test_metrics_are_taken_of_batches_of_colour_images(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="N, H, W, 3"):
        metric_space(np.zeros(shape, np.float32))


@pytest.mark.parametrize("metric", [mse, mssim, flip])
def test_a_prediction_is_compared_with_one_reference_of_its_size(metric) -> None:
    with pytest.raises(ValueError, match="reference"):
        metric(torch.zeros(2, 16, 16, 3), torch.zeros(1, 16, 16, 3))


# --------------------------------------------------------------------------------------------------------------- MSE


def test_mse_is_the_mean_squared_difference_of_each_image() -> None:
    black, greys = torch.zeros(3, 4, 5, 3), torch.tensor([0.0, 0.1, 0.5])
    assert mse(greys[:, None, None, None].expand(3, 4, 5, 3), black) == pytest.approx([0, 0.01, 0.25])


def test_of_what_was_made_from_half_a_the_noise_is_taken_out_as_well() -> None:
    """f = A as it is: (f − A)(f − B) is 0 whatever the noise, and f² − 2fB + AB averages to A's variance."""
    rng = np.random.default_rng(0)
    a, b = (torch.from_numpy(0.5 + 0.1 * rng.standard_normal((50, 16, 16, 3))).float() for _ in "ab")
    assert mse(a, a, b) == pytest.approx(0)
    found = mse(a, a, b, having_seen_a=True)
    assert found.mean() == pytest.approx(0.01, abs=4 * found.std() / 50**0.5)


def test_images_are_taken_a_few_at_a_time_and_all_of_them() -> None:
    images, wanted, a, b = (_pictures(2 * CHUNK + 3, (16, 16), seed) for seed in range(4))
    found = measure_images(images, wanted, None, None, (a, b), having_seen_a=True)
    expected = mse(metric_space(images), metric_space(a), metric_space(b), having_seen_a=True)
    assert found.mse.values == pytest.approx(expected.tolist())
    assert len(found.mssim.values) == len(found.flip.values) == 2 * CHUNK + 3


# --------------------------------------------------------------------------------------------------------- intervals


@pytest.mark.parametrize("freedom", [1, 2, 3, 5, 10, 100, 10_000])
def test_the_quantile_of_students_t_is_that_of_scipy_within_two_thousandths(freedom: int) -> None:
    assert t_975(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=2e-3)


def test_an_interval_is_students_and_needs_two_groups() -> None:
    values = np.array([1.0, 2.0, 4.0, 9.0])
    found = PerImage.of(values)
    expected = stats.t.interval(0.95, 3, loc=values.mean(), scale=stats.sem(values))
    assert found.interval == pytest.approx(expected, abs=2e-3 * (expected[1] - expected[0]))
    assert PerImage.of(values, ["a"] * 4).interval is None
    assert confidence_interval(PerImage.of(values[:1]).estimate) is None
    with pytest.raises(ValueError, match="degree"):
        t_975(0)


# ------------------------------------------------------------------------------------------------------------- MSSIM


def test_mssim_agrees_with_scikit_image_to_five_digits() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    clean, other = metric_space(_pictures(2, (40, 31), 9)), metric_space(_noisy(_pictures(2, (40, 31), 9), 0.5, 10))
    how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = [
        metrics.structural_similarity(x.astype(np.float64), y.astype(np.float64), channel_axis=-1, **how)
        for x, y in zip(clean.numpy(), other.numpy(), strict=True)
    ]
    assert mssim(clean, other) == pytest.approx(expected, abs=1e-5)


def test_mssim_is_1_for_equal_images_and_needs_room_for_a_window() -> None:
    images = metric_space(_pictures(2, (11, 12), 11))
    assert mssim(images, images) == pytest.approx([1, 1])
    with pytest.raises(ValueError, match="11×11"):
        mssim(images[:, :10], images[:, :10])


# -------------------------------------------------------------------------------------------------------------- FLIP


def test_flip_is_that_of_a_viewer_who_sees_67_pixels_per_degree() -> None:
    """The authors' viewer: 0.7 m before a screen of 3840 pixels and 0.7 m."""
    clean = _pictures(1, (32, 48), 12)
    shown, wanted = metric_space(_noisy(clean, 0.3, 13)), metric_space(clean)
    viewer = {"vc": [0.7, 3840.0, 0.7]}
    expected = evaluate(wanted[0].numpy(), shown[0].numpy(), "LDR", applyMagma=False, parameters=viewer)[1]
    assert flip(shown, wanted) == pytest.approx([expected], rel=1e-6)


@pytest.mark.parametrize("metric", [mse, mssim, flip])
def test_every_image_has_its_own_value_whatever_else_is_in_the_batch(metric) -> None:
    clean = _pictures(3, (16, 16), 14)
    shown, wanted = metric_space(_noisy(clean, 0.3, 15)), metric_space(clean)
    alone = [float(metric(shown[i : i + 1], wanted[i : i + 1])[0]) for i in range(3)]
    assert metric(shown, wanted) == pytest.approx(alone, rel=1e-9)
    assert len({round(value, 9) for value in alone}) == 3
    assert all(math.isfinite(value) for value in alone)
