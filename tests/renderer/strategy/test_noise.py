"""What noise costs training and images, and light that images miss, by chance or for want of a technique."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.renderer.strategy.noise import (
    BlockSums,
    Purpose,
    charge_for_missed,
    pair_errors,
    training_weights,
    view_weights,
)

SIDE, CANDIDATES, CONNECTED = 64, 6, 0.15
SHAPE = (32, 32, 3)

Draw = Callable[[np.random.Generator], NDArray[np.float64]]
"""One image, (SIDE, SIDE)."""


# ------------------------------------------------------------------------------------------------------ missed light


def independent(rng: np.random.Generator) -> NDArray[np.float64]:
    """Variance 0.25 in every pixel."""
    return rng.gamma(4.0, 0.25, (SIDE, SIDE))


def dependent(rng: np.random.Generator) -> NDArray[np.float64]:
    """The same, with parts of the noise that all pixels of 16 × 16 have, and of the whole image: ρ is about 13."""
    patches = np.kron(rng.normal(0, CONNECTED / 4, (SIDE // 16, SIDE // 16)), np.ones((16, 16)))
    return independent(rng) + patches + rng.normal(0, CONNECTED / 5)


def sums_of(draw: Draw, views: int, pairs: int, rng: np.random.Generator) -> BlockSums:
    sums = BlockSums()
    for view in range(views):
        for _ in range(pairs):
            a, b = (np.repeat(draw(rng)[..., None], 3, axis=-1).astype(np.float32) for _ in "ab")
            sums.add(a, b, np.ones_like(a), view)
    return sums


@pytest.mark.parametrize("draw", [independent, dependent])
@pytest.mark.parametrize(("views", "pairs"), [(8, 1), (3, 2), (1, 1)])
def test_candidates_of_one_mean_are_charged_next_to_nothing_for_few_images(draw: Draw, views: int, pairs: int) -> None:
    """Their error is 0.25. With z instead of t, and pixels taken as independent, the charge is several times that."""
    charges = []
    for seed in range(8):
        rng = np.random.default_rng([seed, views])
        candidates = [sums_of(draw, views, pairs, rng) for _ in range(CANDIDATES)]
        charges += [
            charge_for_missed(sums, [other for other in candidates if other is not sums]) for sums in candidates
        ]
    assert np.mean(charges) < 0.02 * 0.25


def with_caustic(rng: np.random.Generator) -> NDArray[np.float64]:
    """Half of the samples bring light of 2 in a corner of 16 × 16 pixels."""
    image = dependent(rng)
    image[:16, :16] += 2.0 * (rng.random((16, 16)) < 0.5)
    return image


@pytest.mark.parametrize("seed", range(4))
def test_a_candidate_that_misses_a_caustic_is_charged_for_one_pair_of_images_in_each_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    without, finds = sums_of(dependent, 8, 1, rng), sums_of(with_caustic, 8, 1, rng)
    assert charge_for_missed(without, [finds]) > 0.25  # more than the noise that is seen
    assert charge_for_missed(finds, [without]) < 0.02 * 0.25


def test_one_lucky_sample_does_not_convict_the_others() -> None:
    rng = np.random.default_rng(5)
    ordinary, lucky = BlockSums(), BlockSums()
    for i in range(4):
        a, b, c, d = (1 + 0.1 * rng.standard_normal((4, *SHAPE))).astype(np.float32)
        c[3, 3] += 5000.0 * (i == 2)
        ordinary.add(a, b, np.ones_like(a))
        lucky.add(c, d, np.ones_like(a))
    assert charge_for_missed(ordinary, [lucky]) == 0


# --------------------------------------------------------------------------------------------------- noise that is seen


def four_images(bright: tuple[int, ...]) -> F32:
    """Two pairs of images of relMSE 0.01; some of them have one very bright sample."""
    images = (1 + 0.1 * np.random.default_rng(6).standard_normal((4, *SHAPE))).astype(np.float32)
    for image in bright:
        images[image, 5, 5] += 3000.0
    return images


def test_bright_samples_that_all_candidates_share_are_not_counted_and_those_of_one_are() -> None:
    weights = np.ones(SHAPE, np.float32)
    a, b, c, d = four_images((0, 2))
    errors, shared = pair_errors([(a, b), (c, d)], weights)
    assert shared == pytest.approx(3000**2 / 2 / 1024, rel=0.01)
    assert max(errors) < 2e-4 * shared
    a, b, c, d = four_images((0,))
    (lucky, other), shared = pair_errors([(a, b), (c, d)], weights)
    assert shared == 0
    assert lucky == pytest.approx(3000**2 / 2 / 1024, rel=0.01)
    assert other == pytest.approx(0.01, rel=0.3)


def test_a_pixel_at_the_edge_of_a_light_does_not_rule_the_error() -> None:
    """Few samples miss the part of a light that a pixel holds; the pixels around it do not."""
    images = np.full((8, 16, 16, 3), 0.1, np.float32)
    images[:, 4:8, 4:8] = 20.0
    images[:, 4, 4:8] = 0.1  # none of the samples hit
    weights = view_weights(list(images))
    assert weights is not None
    assert weights[4, 5, 0] < 1 / 5


def error_for(purpose: Purpose, images: F32, exposure: float = 1.0) -> float:
    weights = purpose.weigh(exposure)(list(images[:8]))
    assert weights is not None
    return pair_errors([(images[8], images[9])], weights)[0][0]


def test_noise_in_the_dark_counts_for_images_and_noise_in_the_light_for_training() -> None:
    """An image of means 0.02 and 1 in its halves, with variances 1e-3 and 0.05, or 1e-4 in the dark.

    Weights of images: 1/(r² + 0.01·0.51²), 333 and 0.997, so 0.1915 and 0.0416; of training: 1/(r² + 0.05), 19.8 and
    0.952, so 0.0337 and 0.0248. What is measured is a little less, as the brighter of two noisy references counts.
    """

    def draw(dark: float) -> F32:
        rng = np.random.default_rng(1)
        halves = [
            rng.gamma(mean**2 / variance, variance / mean, (10, 16, 32, 3))
            for mean, variance in ((0.02, dark), (1.0, 0.05))
        ]
        return np.concatenate(halves, axis=1).astype(np.float32)

    errors = {purpose: [error_for(purpose, draw(dark)) for dark in (1e-3, 1e-4)] for purpose in Purpose}
    assert errors[Purpose.IMAGES] == pytest.approx([0.1915, 0.0416], rel=0.15)
    assert errors[Purpose.TRAINING] == pytest.approx([0.0337, 0.0248], rel=0.1)
    for factor in (1 / 64, 64):  # a factor on radiance that the exposure takes back changes nothing
        exposed = error_for(Purpose.TRAINING, draw(1e-3) * np.float32(factor), 1 / factor)
        assert exposed == pytest.approx(errors[Purpose.TRAINING][0], rel=1e-5)


def test_a_dark_view_counts_like_others_for_images_and_little_for_training() -> None:
    """Its pixels have the same relative noise, at a hundredth of the radiance."""
    bright = np.random.default_rng(1).gamma(4, 0.25, (10, *SHAPE)).astype(np.float32)
    dark = bright / 100
    assert error_for(Purpose.IMAGES, dark) == pytest.approx(error_for(Purpose.IMAGES, bright), rel=1e-4)
    assert error_for(Purpose.TRAINING, dark) < 1e-2 * error_for(Purpose.TRAINING, bright)


def test_a_black_view_has_no_weights() -> None:
    black = [np.zeros(SHAPE, np.float32)] * 2
    assert view_weights(black) is None
    assert training_weights(black, 1.0) is None
