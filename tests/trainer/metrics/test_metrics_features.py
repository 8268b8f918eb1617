"""Metrics of Inception features, and the whole row: FID, KID, Feature L1, image_metrics."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import scipy.linalg
import torch
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.trainer.metrics import (
    Features,
    Inception,
    InceptionWeights,
    feature_l1,
    fid,
    kid,
    load_inception,
    measure_images,
    metric_space,
)
from photonfarm.trainer.metrics.fid import ROWS


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


def test_fid_of_a_set_with_itself_is_0_and_never_below() -> None:
    a = np.random.default_rng(5).standard_normal((30, 2048)).astype(np.float32)
    assert 0 <= fid(a, a).value < 1e-9


def test_fid_says_of_how_many_images_it_is_and_warns_below_2048() -> None:
    few = fid(np.eye(4)[:3], np.eye(4))
    assert (few.predictions, few.references) == (3, 4)
    assert few.warning is not None
    assert "FID of 3 images: below 2048 its covariance is singular" in few.warning
    many = np.random.default_rng(6).standard_normal((2048, 3))
    assert fid(many, many).warning is None
    with pytest.raises(ValueError, match="two"):
        fid(np.eye(4)[:1], np.eye(4))


# --------------------------------------------------------------------------------------------------------------- KID


def _kid_by_loops(x: NDArray, y: NDArray) -> float:
    def kernel(a: NDArray, b: NDArray) -> float:
        return (a @ b / len(a) + 1) ** 3

    n = len(x)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    terms = (kernel(x[i], x[j]) + kernel(y[i], y[j]) - kernel(x[i], y[j]) - kernel(x[j], y[i]) for i, j in pairs)
    return sum(terms) / len(pairs)


def test_kid_is_the_sum_over_pairs() -> None:
    x, y = np.random.default_rng(7).standard_normal((2, 11, 5))
    y = y * 1.5 + 0.3
    assert kid(x, y).mean == pytest.approx(_kid_by_loops(x, y), rel=1e-10)


def test_kid_is_the_same_where_the_pairs_are_too_many_to_be_held_at_once() -> None:
    x, y = np.random.default_rng(7).standard_normal((2, 2 * ROWS + 5, 2)) + np.array([[[0.0]], [[0.3]]])
    pairs = sum(sign * (a @ b.T / 2 + 1) ** 3 for sign, a, b in ((1, x, x), (1, y, y), (-1, x, y), (-1, y, x)))
    count = len(x)
    assert kid(x, y).mean == pytest.approx((pairs.sum() - np.trace(pairs)) / (count * (count - 1)), rel=1e-9)


def test_kid_has_the_standard_error_of_leaving_one_view_out() -> None:
    rng = np.random.default_rng(8)
    x, y = rng.standard_normal((2, 9, 4))
    without = np.array([_kid_by_loops(np.delete(x, i, 0), np.delete(y, i, 0)) for i in range(9)])
    expected = np.sqrt(8 / 9 * np.sum((without - without.mean()) ** 2))
    assert kid(x, y).standard_error == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("tied", [0.0, 0.9])
def test_kid_is_unbiased_also_where_the_pairs_show_the_same_views(tied: float) -> None:
    """Equal distributions have MMD² 0 however many images there are, and however alike the two of a pair are.

    4000 sets of 6 images; |mean| < 4 standard errors, p = 6e-5. With the pairs left in it would be 20 and more off.
    """
    rng = np.random.default_rng(9)
    found, with_pairs = [], []
    for _ in range(4000):
        x, own = rng.standard_normal((2, 6, 4))
        y = tied * x + np.sqrt(1 - tied**2) * own
        found.append(kid(x, y).mean)
        cross = (x @ y.T / 4 + 1) ** 3
        with_pairs.append(2 * (cross.sum() - np.trace(cross)) / 30 - 2 * cross.mean() + found[-1])
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found)) < 4 * error
    assert tied == 0 or np.mean(with_pairs) < -20 * error


def test_kid_of_different_distributions_is_the_closed_form() -> None:
    """One feature, x ~ N(0, 1), y ~ N(m, 1), k = (xy + 1)³: MMD² = 3 (E x − E y)² + 3 (E x² − E y²)² + (E x³ − E y³)².

    With m = 1: moments 0, 1, 0 against 1, 2, 4, so 3 + 3 + 16 = 22. Within 4 standard errors, p = 6e-5.
    """
    rng = np.random.default_rng(10)
    found = kid(rng.standard_normal((3000, 1)), rng.standard_normal((3000, 1)) + 1)
    assert found.standard_error is not None
    assert found.standard_error < 2
    assert abs(found.mean - 22) < 4 * found.standard_error


def test_kid_needs_two_sets_of_the_same_size_and_three_images() -> None:
    for predictions, references, named in ((4, 3, "equal"), (2, 2, "3 images")):
        with pytest.raises(ValueError, match=named):
            kid(np.zeros((predictions, 5)), np.zeros((references, 5)))


# -------------------------------------------------------------------------------------------- Feature L1 and the row


def _random_inception() -> Inception:
    """A small network with the published one's blocks, and seeded random weights, as loud as a trained one."""
    torch.manual_seed(0)
    widths = {"pool0": (3, 64), "pool1": (64, 192), "mixed_7": (192, 768), "mixed_10": (768, 2048)}
    network = torch.nn.Sequential()
    for name, (width_in, width) in widths.items():
        convolution = torch.nn.Conv2d(width_in, width, 3, stride=4)
        torch.nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        network.add_module(name, torch.nn.Sequential(convolution, torch.nn.ReLU()))
    return Inception(network.requires_grad_(requires_grad=False), InceptionWeights("seeded", "0" * 64, published=False))


def _rooms(count: int, size: int = 16, seed: int = 0) -> NDArray[np.float32]:
    """Coarse random exposed radiance, some of it above white."""
    coarse = np.random.default_rng(seed).gamma(1, 0.5, (count, 4, 4, 3))
    return coarse.repeat(size // 4, axis=1).repeat(size // 4, axis=2).astype(np.float32)


def _noisy(images: NDArray[np.float32], strength: float, seed: int) -> NDArray[np.float32]:
    factor = np.random.default_rng(seed).gamma(1 / strength**2, strength**2, images.shape)
    return (images * factor).astype(np.float32)


def test_feature_l1_is_the_mean_absolute_difference_of_each_image_and_block() -> None:
    widths = (64, 192, 768, 2048)
    black = Features(tuple(np.zeros((2, width), np.float32) for width in widths))
    steps = np.array([[0.5], [-2.0]], np.float32)
    other = Features(tuple(np.repeat(steps, width, axis=1) * (k + 1) for k, width in enumerate(widths)))
    found = feature_l1(other, black)
    assert [block.tolist() for block in found] == [[0.5, 2], [1, 4], [1.5, 6], [2, 8]]


def test_a_row_holds_every_metric_per_image_with_intervals_and_is_json() -> None:
    references = _rooms(4)
    found = measure_images(_noisy(references, 0.3, 1), torch.from_numpy(references), _random_inception())
    assert (found.images, len(found.mse.values), len(found.mssim.values), len(found.flip.values)) == (4, 4, 4, 4)
    assert found.feature_l1 is not None
    assert [len(block.values) for block in found.feature_l1] == [4] * 4
    for metric in (found.mse, found.mssim, found.flip, *found.feature_l1):
        assert metric.interval is not None
        assert metric.interval[0] < metric.estimate.mean < metric.interval[1]
        assert metric.estimate.mean == pytest.approx(np.mean(metric.values))
    assert found.fid is not None
    assert found.fid.warning is not None
    assert found.kid is not None
    record = json.loads(json.dumps(asdict(found), allow_nan=False))
    assert record["fid"]["predictions"] == 4
    assert record["inception"] == {"source": "seeded", "sha256": "0" * 64, "published": False}
    assert record["mse"]["estimate"]["mean"] == found.mse.estimate.mean
    assert set(found.columns()) == {"MSE", "MSSIM", "FID", "KID", "Feature L1", "FLIP"}
    assert "n/a" not in found.columns().values()


def test_more_noise_is_worse_in_every_column() -> None:
    references, inception = _rooms(3), _random_inception()
    low, high = (measure_images(_noisy(references, strength, 2), references, inception) for strength in (0.1, 0.6))
    assert low.mse.estimate.mean < high.mse.estimate.mean
    assert low.mssim.estimate.mean > high.mssim.estimate.mean
    assert low.flip.estimate.mean < high.flip.estimate.mean
    assert low.fid is not None
    assert high.fid is not None
    assert low.fid.value < high.fid.value
    assert low.kid is not None
    assert high.kid is not None
    assert low.kid.mean < high.kid.mean
    assert low.feature_l1 is not None
    assert high.feature_l1 is not None
    for quiet, loud in zip(low.feature_l1, high.feature_l1, strict=True):
        assert quiet.estimate.mean < loud.estimate.mean


def test_equal_images_have_no_error() -> None:
    references = _rooms(3)
    columns = measure_images(references, references, _random_inception()).columns()
    assert {name: float(value) for name, value in columns.items()} == {
        "MSE": 0,
        "MSSIM": 1,
        "FID": 0,
        "KID": 0,
        "Feature L1": 0,
        "FLIP": 0,
    }


def test_without_weights_the_columns_of_inception_say_so() -> None:
    references = _rooms(4)
    found = measure_images(_noisy(references, 0.3, 3), references, None)
    assert (found.feature_l1, found.fid, found.kid, found.inception) == (None, None, None, None)
    assert {name for name, value in found.columns().items() if value == "n/a"} == {"FID", "KID", "Feature L1"}
    assert json.loads(json.dumps(asdict(found), allow_nan=False))["fid"] is None


def test_two_images_have_no_fid_but_all_else() -> None:
    found = measure_images(_rooms(2), _rooms(2, seed=1), _random_inception())
    assert (found.fid, found.kid) == (None, None)
    assert found.feature_l1 is not None


def test_intervals_are_over_groups_where_they_are_named() -> None:
    references = _rooms(4)
    found = measure_images(_noisy(references, 0.3, 4), references, None, groups=["a", "a", "b", "b"])
    assert (found.mse.estimate.count, len(found.mse.values)) == (2, 4)


def test_a_row_of_images_that_are_not_numbers_is_refused() -> None:
    spoilt = _rooms(2)
    spoilt[1] = np.nan
    with pytest.raises(SpecError):
        measure_images(spoilt, _rooms(2), None)


def test_with_the_published_weights_noise_shows_in_fid_and_feature_l1_as_it_grows() -> None:
    inception = load_inception()
    if inception is None:
        pytest.skip("no weights of the FID Inception are installed")
    references = _rooms(3, size=32)
    sets = [metric_space(_noisy(references, strength, 5)) for strength in (0.1, 0.8)]
    clean = inception.features(metric_space(references))
    found = [inception.features(images) for images in sets]
    assert np.all(np.diff([fid(features.pool3, clean.pool3).value for features in found]) > 0)
    assert np.all(np.diff([kid(features.pool3, clean.pool3).mean for features in found]) > 0)
    assert np.all(np.diff([feature_l1(features, clean)[3].mean() for features in found]) > 0)
