"""The points are nets whatever the seed, every number is uniform, and what must be independent is uncorrelated."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from photonfarm.renderer.bdpt import randomness
from photonfarm.renderer.bdpt.launches import Launch
from tests.stability.scenes.hard_scenes import HARD_SCENES

SIGNIFICANCE = 1e-5  # of each test, over all its comparisons together; the seeds are fixed
SEEDS = (0, 1, 12345, 0xFFFFFFFF)


def points(seed: int, n: int, pairs: int = 1, number: int = 0) -> Any:
    """[n, 2·pairs]: the first pairs of dimensions of the first points of a sequence."""
    sequence = randomness.stream(randomness.image_keys([seed]), randomness.EYE, number)
    rng = randomness.sampler(sequence, dr.arange(mi.UInt32, n))
    return np.concatenate([np.array(rng.next_2d()).T for _ in range(pairs)], axis=1).astype(np.float64)


def is_net(xy: Any, m: int) -> bool:
    """Return whether 2^m points lie one in each of the 2^m elementary intervals 2^−a × 2^−(m−a), for every a."""
    for a in range(m + 1):
        column, row = (xy[:, 0] * 2**a).astype(int), (xy[:, 1] * 2 ** (m - a)).astype(int)
        if len(np.unique(column * 2 ** (m - a) + row)) != 2**m:
            return False
    return True


# ------------------------------------------------ Nets ------------------------------------------------


@pytest.mark.parametrize("m", [0, 1, 4, 7, 10])
@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_nets_in_base_two_in_every_pair_of_dimensions(seed: int, m: int) -> None:
    all_pairs = points(seed, 2**m, pairs=5)
    for pair in range(5):
        assert is_net(all_pairs[:, 2 * pair : 2 * pair + 2], m), f"pair {pair}"


def test_a_thousand_sequences_are_nets() -> None:
    sequences, n = 1000, 16
    number = dr.repeat(dr.arange(mi.UInt32, sequences), n)
    key = dr.gather(mi.UInt32, randomness.image_keys([3]), dr.zeros(mi.UInt32, sequences * n))
    rng = randomness.sampler(
        randomness.stream(key, randomness.EYE, number), dr.tile(dr.arange(mi.UInt32, n), sequences)
    )
    xy = np.array(rng.next_2d()).T.reshape(sequences, n, 2)
    assert all(is_net(each, 4) for each in xy)


# ------------------------------------------------ Uniform ------------------------------------------------

READS = ("next_2d", "next_1d", "next_independent")


def first_of_each(sequences: int, read: str, index: int) -> Any:
    """[sequences, 1 or 2]: point ``index`` of each of many sequences: as independent numbers as there are."""
    key = dr.gather(mi.UInt32, randomness.image_keys([2]), dr.zeros(mi.UInt32, sequences))
    sequence = randomness.stream(key, randomness.EYE, dr.arange(mi.UInt32, sequences))
    rng = randomness.sampler(sequence, dr.full(mi.UInt32, index, sequences))
    rng.next_2d()
    values = np.array(getattr(rng, read)())
    return values.T if values.ndim == 2 else values[:, None]


@pytest.mark.parametrize("read", READS)
@pytest.mark.parametrize("index", [0, 1, 5])
def test_each_coordinate_of_a_point_is_uniform_over_the_sequences(read: str, index: int) -> None:
    for values in first_of_each(1 << 14, read, index).T:
        assert stats.kstest(values, "uniform").pvalue > SIGNIFICANCE


# ------------------------------------------------ Uncorrelated ------------------------------------------------


def assert_uncorrelated(columns: Any) -> None:
    """No two of the columns [n, D] have a correlation beyond chance (normal, Šidák over all pairs)."""
    n, dimensions = columns.shape
    r = np.corrcoef(columns, rowvar=False)[np.triu_indices(dimensions, 1)]
    limit = stats.norm.isf((1 - (1 - SIGNIFICANCE) ** (1 / r.size)) / 2) / np.sqrt(n)
    assert np.abs(r).max() < limit, f"largest correlation {np.abs(r).max():.4f}, by chance up to {limit:.4f}"


# Within one net the order of points in two pairs is a random permutation of the other's at most: a correlation over the
# points of one sequence varies like 1/√n, over sequences it has mean 0
def test_pairs_of_dimensions_are_uncorrelated() -> None:
    rows = [points(seed, 16, pairs=6) for seed in range(400)]
    assert_uncorrelated(np.concatenate(rows) - 0.5)


def test_sequences_of_pixels_purposes_and_seeds_are_uncorrelated() -> None:
    n = 4096
    columns = [points(seed, n, number=number) for seed in (0, 1, 2) for number in (0, 1, 2, 17)]
    for purpose in (randomness.LIGHT, randomness.PHOTONS):
        rng = randomness.sampler(randomness.stream(randomness.image_keys([0]), purpose), dr.arange(mi.UInt32, n))
        columns.append(np.array(rng.next_2d()).T)
    assert_uncorrelated(np.concatenate(columns, axis=1))


def test_an_estimate_over_sequences_has_the_expectation_of_independent_numbers() -> None:
    def integrand(xyz: Any) -> Any:  # mean 1/8 + 1/4
        return xyz[..., 0] * xyz[..., 1] * xyz[..., 2] + (xyz[..., 0] > 0.5) * (xyz[..., 3] > 0.5)

    estimates = [integrand(points(seed, 8, pairs=2)).mean() for seed in range(2000)]
    assert stats.ttest_1samp(estimates, 0.375).pvalue > SIGNIFICANCE
    assert np.std(estimates) < 0.9 * np.sqrt((1 / 27 - 1 / 64 + 3 / 16 + 2 * (9 / 64 - 1 / 32)) / 8)  # and less noise


# ------------------------------------------------ Along the curve ------------------------------------------------


def on_curve(n: int) -> Any:
    """[n, 2]."""
    lane = dr.arange(mi.UInt32, n)
    rng = randomness.sampler(dr.full(mi.UInt32, n, n), lane)
    return np.array(randomness.along_curve(lane, dr.opaque(mi.UInt32, n), rng)).T


def position_on_curve(xy: Any) -> Any:
    """The positions of points in [0, 1)² on the curve, by taking bits in turn (x first: the lower one)."""
    bits = 16
    ints = (np.asarray(xy, np.float64) * 2**bits).astype(np.uint64)
    code = np.zeros(len(ints), np.uint64)
    for bit in range(bits):
        for axis in (0, 1):
            code |= ((ints[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(2 * bit + axis)
    return code / 2 ** (2 * bits)


def test_points_along_the_curve_are_uniform_below_its_bits_too() -> None:
    """A curve of 16 bits for each coordinate alone would put all directions near a light's axis onto the axis."""
    xy = on_curve(1 << 18)
    below = (xy.astype(np.float64) * 65536) % 1
    assert abs(below.mean() - 0.5) < 5 * np.sqrt(1 / 12 / below.size) + 2**-8  # floats near 1 keep 8 bits below
    assert np.mean(below == 0) < 2**-7
    nearest = np.sort(xy[:, 0])[:64] * 65536
    assert 0 < nearest[0] < 0.25 * 64


@pytest.mark.parametrize("n", [1, 2, 3, 100, 1000, 1023, 1024])
def test_lanes_along_the_curve_are_stratified_for_any_number(n: int) -> None:
    xy = on_curve(n)
    assert ((xy >= 0) & (xy < 1)).all()
    # One point in each of n equal pieces of the curve, but for what lies nearer to a border than a bit of the position
    piece = position_on_curve(xy) * n
    assert (np.abs(piece - (np.arange(n) + 0.5)) <= 0.5 + n * 2.0**-30).all()


# ------------------------------------------------ Shifts ------------------------------------------------


def launch(light_paths: int, images: int = 1, first_sample: int = 0) -> Launch:
    return Launch(
        images=images, first_image=0, samples=4, first_sample=first_sample, light_paths=light_paths, first_light_path=0
    )


def test_shifts_belong_to_a_seed_and_to_a_part_of_its_samples() -> None:
    together = np.array(randomness.shifts([5, 6], launch(1000, images=2), 3)).reshape(2, -1)
    alone = [np.array(randomness.shifts([seed], launch(1000), 3)) for seed in (5, 6)]
    np.testing.assert_array_equal(together, alone)
    later = np.array(randomness.shifts([5], launch(1000, first_sample=4), 3))
    assert_uncorrelated(np.stack([*alone, later], axis=1))


def test_an_image_is_joined_to_light_paths_from_everywhere_also_where_they_outnumber_the_eye_paths() -> None:
    """Neighbouring light paths start alike; joined to a quarter of them side by side, images were 8 times as noisy."""
    scene = mi.load_dict(HARD_SCENES["constant_environment"](24), optimize=False)

    def spread(ratio: float) -> float:
        integrator = mi.load_dict({"type": "bdpt", "max_depth": 6, "connections": 1, "light_ratio": ratio})
        means = [float(np.mean(integrator.render(scene, sensor=0, seed=seed, spp=32).numpy())) for seed in range(12)]
        return float(np.std(means))

    assert spread(4.0) < 2 * spread(1.0)
