"""Light paths drawn anew in proportion to their weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.kept_vertices import resample

IMAGES, PATHS = 3, 1000


def drawn(weight: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(paths of the slots, factors of the paths), [K, N] both."""
    paths = dr.opaque(mi.UInt32, weight.shape[1])
    found = resample(mi.Float(weight.ravel().tolist()), mi.Float(offset.tolist()), paths)
    slots, factor = (np.array(values).reshape(weight.shape) for values in found)
    return slots, factor


def weights(seed: int) -> np.ndarray:
    """Weights of a wide range, a third of them 0."""
    rng = np.random.default_rng(seed)
    found = 10 ** rng.uniform(-3, 1, (IMAGES, PATHS)) * (rng.random((IMAGES, PATHS)) > 1 / 3)
    return found.astype(np.float32)


def test_a_path_takes_its_part_of_the_slots_up_or_down_to_a_whole_number() -> None:
    weight = weights(0)
    slots, _ = drawn(weight, np.array([0.0, 0.3, 0.99]))
    for k in range(IMAGES):
        copies = np.bincount(slots[k] - k * PATHS, minlength=PATHS)
        assert len(copies) == PATHS, "a slot of an image has a path of another"
        part = PATHS * weight[k].astype(np.float64) / weight[k].astype(np.float64).sum()
        assert np.abs(copies - part).max() < 1 + 1e-3
        assert (copies[weight[k] == 0] == 0).all()


def test_a_sum_over_slots_has_the_expectation_of_the_sum_over_paths() -> None:
    weight = weights(1)[:1]
    value = np.random.default_rng(2).random(PATHS) * weight[0]
    grid = 512
    sums = []
    for offset in (np.arange(grid) + 0.5) / grid:
        slots, factor = drawn(weight, np.array([offset]))
        sums.append((factor[0] * value / np.where(weight[0] > 0, weight[0], 1))[slots[0]].sum())
    # Offsets lie evenly, so each path's mean number of slots is off by 1/grid at most, either way
    assert np.mean(sums) == pytest.approx(value.sum(), rel=2e-3)
    assert np.std(sums) > 0


def test_where_no_path_has_a_weight_slots_have_the_first_path_of_their_image() -> None:
    weight = weights(3)
    weight[1] = 0
    weight[2, 5:] = np.nan, *weight[2, 6:]
    slots, factor = drawn(weight, np.full(3, 0.5))
    assert (slots[1] == PATHS).all()
    assert (factor[1] == 0).all()
    assert not (slots[2] == 2 * PATHS + 5).any()


def test_the_number_of_threads_changes_no_bit() -> None:
    n = 1 << 18
    weight = (10 ** np.random.default_rng(5).uniform(-6, 1, (1, n))).astype(np.float32)
    threads, found = dr.thread_count(), []
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            found.append(drawn(weight, np.array([0.4])))
    finally:
        dr.set_thread_count(threads)
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)
