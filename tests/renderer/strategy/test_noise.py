"""Light that few images miss by chance, and light that they miss because a technique does not find it."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from photonfarm.core.records import F32
from photonfarm.renderer.strategy.noise import BlockSums, charge_for_missed

SIDE, CANDIDATES, CONNECTED = 64, 6, 0.15
WEIGHTS = np.ones((SIDE, SIDE, 3), np.float32)

Draw = Callable[[np.random.Generator], NDArray[np.float64]]
"""One image, (SIDE, SIDE)."""


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
            sums.add(*(as_image(draw(rng)) for _ in "ab"), WEIGHTS, view)
    return sums


def as_image(grey: NDArray[np.float64]) -> F32:
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("draw", [independent, dependent])
@pytest.mark.parametrize(("views", "pairs"), [(8, 1), (3, 2), (1, 1)])
def test_candidates_of_one_mean_are_charged_next_to_nothing_for_few_images(draw: Draw, views: int, pairs: int) -> None:
    """Their error is 0.25. With z instead of t, and pixels taken as independent, the charge is several times that."""
    charges = []
    for seed in range(10):
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


@pytest.mark.parametrize("seed", range(8))
def test_a_candidate_that_misses_a_caustic_is_charged_for_one_pair_of_images_in_each_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    without, finds = sums_of(dependent, 8, 1, rng), sums_of(with_caustic, 8, 1, rng)
    assert charge_for_missed(without, [finds]) > 0.25  # more than the noise that is seen
    assert charge_for_missed(finds, [without]) < 0.02 * 0.25
