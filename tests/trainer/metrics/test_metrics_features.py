"""Metrics of Inception features, and the whole row: FID, KID, Feature L1, image_metrics."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import scipy.linalg
import torch
from numpy.typing import NDArray
from random_inception import random_inception

from photonfarm.core.errors import SpecError
from photonfarm.trainer.metrics.features import ROWS, fid, kid, load_inception
from photonfarm.trainer.metrics.image_metrics import TITLES, feature_l1, measure_images, metric_space


def _normal(count: int, mean: NDArray, root: NDArray, seed: int, *, exact: bool = False) -> NDArray[np.float64]:
    """Features with this mean and covariance root·rootᵀ, of the sample itself if `exact`; (count, D)."""
    x = np.random.default_rng(seed).standard_normal((count, len(mean)))
    if exact:
        x -= x.mean(axis=0)
        x = np.linalg.solve(np.linalg.cholesky(np.cov(x.T)), x.T).T
    return mean + x @ root.T


def _by_sqrtm(a: NDArray, b: NDArray) -> float:
    """Heusel et al.'s formula, letter by letter."""
    cov_a, cov_b = np.cov(a.T), np.cov(b.T)
    mean = np.sum((a.mean(axis=0) - b.mean(axis=0)) ** 2)
    return float(mean + np.trace(cov_a + cov_b - 2 * scipy.linalg.sqrtm(cov_a @ cov_b).real))


# --------------------------------------------------------------------------------------------------------------- FID


@pytest.mark.parametrize("count", [9, 40])  # below and above the width: without and with QR
def test_fid_of_scaled_normals_is_the_closed_form(count: int) -> None:
    """Σ = I and T = 4 I at means 3 apart in each of 8 features: 8·9 + 8·(1 − 2)² = 80."""
    a = _normal(count, np.zeros(8), np.eye(8), 0, exact=True)
    b = _normal(count, np.full(8, 3.0), 2 * np.eye(8), 1, exact=True)
    assert fid(a, b).value == pytest.approx(80, rel=1e-9)


def test_fid_is_the_formula_with_a_matrix_root() -> None:
    rng = np.random.default_rng(2)
    a = _normal(60, rng.normal(size=12), rng.normal(size=(12, 12)), 3)
    b = _normal(45, rng.normal(size=12), rng.normal(size=(12, 12)), 4)
    assert fid(a, b).value == pytest.approx(_by_sqrtm(a, b), rel=1e-7)
    assert fid(a, b).value == pytest.approx(fid(b, a).value, rel=1e-9)


def test_fid_of_few_images_is_exact_where_covariances_are_singular() -> None:
    """Two of rank 1, along e₁ and e₂ with variances 4 and 9: they do not overlap, and 4 + 9 remains."""
    along = np.array([-1.0, 1.0])[:, None] / np.sqrt(2)
    e = np.eye(2048)
    assert fid(2 * along * e[0], 3 * along * e[1]).value == pytest.approx(13, rel=1e-12)
    assert fid(2 * along * e[0], 3 * along * e[0]).value == pytest.approx((3 - 2) ** 2, rel=1e-9)


def test_fid_says_of_how_many_images_it_is_and_warns_below_2048() -> None:
    few = fid(np.eye(4)[:3], np.eye(4))
    assert (few.predictions, few.references) == (3, 4)
    assert few.warning is not None
    assert "FID of 3 images: below 2048 its covariance is singular" in few.warning
    many = np.random.default_rng(6).standard_normal((2048, 3))
    assert fid(many, many).warning is None
    assert 0 <= fid(many, many).value < 1e-9, "of a set with itself, and never below"
    with pytest.raises(ValueError, match="two"):
        fid(np.eye(4)[:1], np.eye(4))


# --------------------------------------------------------------------------------------------------------------- KID


def _kid_by_pairs(x: NDArray, y: NDArray) -> float:
    """The sum of all kernels but those of one view with itself."""
    width, count = x.shape[1], len(x)
    kernels = ((1, x, x), (1, y, y), (-1, x, y), (-1, y, x))
    pairs = sum(sign * (a @ b.T / width + 1) ** 3 for sign, a, b in kernels)
    return (pairs.sum() - np.trace(pairs)) / (count * (count - 1))


@pytest.mark.parametrize("count", [11, 2 * ROWS + 5])  # the second are too many to be held at once
def test_kid_is_the_sum_over_pairs(count: int) -> None:
    x, y = np.random.default_rng(7).standard_normal((2, count, 3)) + np.array([[[0.0]], [[0.3]]])
    assert kid(x, y).mean == pytest.approx(_kid_by_pairs(x, y), rel=1e-9)


def test_kid_has_the_standard_error_of_leaving_one_view_out() -> None:
    x, y = np.random.default_rng(8).standard_normal((2, 9, 4))
    without = np.array([_kid_by_pairs(np.delete(x, i, 0), np.delete(y, i, 0)) for i in range(9)])
    expected = np.sqrt(8 / 9 * np.sum((without - without.mean()) ** 2))
    assert kid(x, y).standard_error == pytest.approx(expected, rel=1e-9)


def test_kid_is_unbiased_also_where_the_pairs_show_the_same_views() -> None:
    """Equal distributions have MMD² 0 however many images there are, and however alike the two of a pair are.

    4000 sets of 6 images; |mean| < 4 standard errors, p = 6e-5. With the pairs left in it would be 20 and more off.
    """
    rng, tied = np.random.default_rng(9), 0.9
    found, with_pairs = [], []
    for _ in range(4000):
        x, own = rng.standard_normal((2, 6, 4))
        y = tied * x + np.sqrt(1 - tied**2) * own
        found.append(kid(x, y).mean)
        cross = (x @ y.T / 4 + 1) ** 3
        with_pairs.append(2 * (cross.sum() - np.trace(cross)) / 30 - 2 * cross.mean() + found[-1])
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found)) < 4 * error
    assert np.mean(with_pairs) < -20 * error


def test_kid_needs_two_sets_of_the_same_size_and_three_images() -> None:
    for predictions, references, named in ((4, 3, "equal"), (2, 2, "3 images")):
        with pytest.raises(ValueError, match=named):
            kid(np.zeros((predictions, 5)), np.zeros((references, 5)))


# -------------------------------------------------------------------------------------------- Feature L1 and the row


def _rooms(count: int, size: int = 16, seed: int = 0) -> NDArray[np.float32]:
    """Coarse random exposed radiance, some of it above white."""
    coarse = np.random.default_rng(seed).gamma(1, 0.5, (count, 4, 4, 3))
    return coarse.repeat(size // 4, axis=1).repeat(size // 4, axis=2).astype(np.float32)


def _noisy(images: NDArray[np.float32], strength: float, seed: int) -> NDArray[np.float32]:
    factor = np.random.default_rng(seed).gamma(1 / strength**2, strength**2, images.shape)
    return (images * factor).astype(np.float32)


def test_feature_l1_is_the_mean_absolute_difference_of_each_image_and_block() -> None:
    widths = (64, 192, 768, 2048)
    black = tuple(np.zeros((2, width), np.float32) for width in widths)
    steps = np.array([[0.5], [-2.0]], np.float32)
    other = tuple(np.repeat(steps, width, axis=1) * (k + 1) for k, width in enumerate(widths))
    assert [block.tolist() for block in feature_l1(other, black)] == [[0.5, 2], [1, 4], [1.5, 6], [2, 8]]


def test_a_row_holds_every_metric_per_image_with_intervals_and_is_json() -> None:
    references = _rooms(4)
    found = measure_images(_noisy(references, 0.3, 1), torch.from_numpy(references), random_inception())
    assert found.images == 4
    for metric in (found.mse, found.mssim, found.flip, *found.feature_l1):
        assert len(metric.values) == 4
        assert metric.interval[0] < metric.estimate.mean < metric.interval[1]
        assert metric.estimate.mean == pytest.approx(np.mean(metric.values))
    record = json.loads(json.dumps(asdict(found), allow_nan=False))
    assert record["fid"]["predictions"] == 4
    assert record["inception"] == {"source": "seeded", "sha256": "0" * 64, "published": False}
    assert record["mse"]["estimate"]["mean"] == found.mse.estimate.mean
    assert found.estimates().keys() == TITLES.keys()


def test_equal_images_have_no_error_and_more_noise_is_worse_in_every_column() -> None:
    references, inception = _rooms(3), random_inception()
    none, low, high = (
        measure_images(images, references, inception).estimates()
        for images in (references, _noisy(references, 0.1, 2), _noisy(references, 0.6, 2))
    )
    for name in TITLES:
        perfect = 1 if name == "mssim" else 0
        assert none[name].mean == pytest.approx(perfect, abs=1e-6)
        assert abs(low[name].mean - perfect) < abs(high[name].mean - perfect)


def test_without_weights_and_of_two_images_there_is_what_can_be_had() -> None:
    references = _rooms(4)
    found = measure_images(_noisy(references, 0.3, 3), references, None)
    assert set(found.estimates()) == {"mse", "mssim", "flip"}
    assert json.loads(json.dumps(asdict(found), allow_nan=False))["fid"] is None
    found = measure_images(_rooms(2), _rooms(2, seed=1), random_inception())
    assert (found.fid, found.kid) == (None, None)
    assert found.feature_l1 is not None


def test_a_row_of_images_that_are_not_numbers_is_refused() -> None:
    spoilt = _rooms(2)
    spoilt[1] = np.nan
    with pytest.raises(SpecError, match="image 1 of 2"):
        measure_images(spoilt, _rooms(2), None)


def test_with_the_published_weights_noise_shows_in_fid_and_feature_l1_as_it_grows() -> None:
    inception = load_inception()
    if inception is None:
        pytest.skip("no weights of the FID Inception are installed")
    references = _rooms(3, size=32)
    clean, *found = (
        inception.features(metric_space(images))
        for images in (references, *(_noisy(references, strength, 5) for strength in (0.1, 0.8)))
    )
    assert np.all(np.diff([fid(features[-1], clean[-1]).value for features in found]) > 0)
    assert np.all(np.diff([kid(features[-1], clean[-1]).mean for features in found]) > 0)
    assert np.all(np.diff([feature_l1(features, clean)[3].mean() for features in found]) > 0)
