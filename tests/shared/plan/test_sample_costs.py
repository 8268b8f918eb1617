"""Costs and noise as JSON, and the noise of images."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from photonfarm.core.errors import StoreError
from photonfarm.plan.sample_costs import SampleCosts, relative_variance

COSTS = SampleCosts("0" * 32, 0.04, 0.035, 0.0, 0.032, 0.3, 0.01)


def test_costs_come_back_as_they_were_written() -> None:
    assert SampleCosts.read(COSTS.json()) == COSTS
    assert SampleCosts.read(COSTS.json().encode()) == COSTS
    assert json.loads(COSTS.json()) == asdict(COSTS)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"scene_id": 1}, "scene_id = 1"),
        ({"view_s": "0.1"}, "view_s = '0.1'"),
        ({"view_s": -0.5}, r"view_s = -0\.5: 0\.0 or more is required"),
        ({"relative_variance": float("nan")}, "relative_variance = nan"),
        ({"more": 1.0}, "more"),
    ],
)
def test_other_values_are_refused_with_their_name_and_what_to_do(change: dict[str, object], named: str) -> None:
    with pytest.raises(StoreError, match=named) as caught:
        SampleCosts.read(json.dumps({**asdict(COSTS), **change}))
    assert "photonfarm scene cost SPEC --again" in str(caught.value)
    with pytest.raises(StoreError):
        SampleCosts.read(COSTS.json()[:-3])
    with pytest.raises(ValueError, match="guides_s"):
        replace(COSTS, guides_s=-1.0)


# -------------------------------------------------------------------------------------------------------------- noise


def noisy(clean: np.ndarray, sigma: np.ndarray | float, spp: int, seed: int = 0) -> np.ndarray:
    """A half-estimate whose samples have the standard deviation `sigma`."""
    normal = np.random.default_rng(seed).standard_normal(clean.shape)
    return (clean + sigma / np.sqrt(spp) * normal).astype(np.float32)


def test_the_noise_of_one_sample_is_found_at_any_number_of_samples_and_any_exposure() -> None:
    clean = np.full((128, 128, 3), 2.0)
    wanted = 0.5**2 / (2**2 * 1.01)
    for half_spp in (1, 4, 64):
        a, b = (noisy(clean, 0.5, half_spp, seed) for seed in (1, 2))
        assert relative_variance(a, b, 2 * half_spp) == pytest.approx(wanted, rel=0.03)
        assert relative_variance(10 * a, 10 * b, 2 * half_spp) == pytest.approx(relative_variance(a, b, 2 * half_spp))


def test_noise_is_relative_to_the_brightness_around_and_in_the_dark_to_a_tenth_of_the_images() -> None:
    clean = np.zeros((64, 64, 3))
    clean[:, :16], clean[:, 16:32] = 8.0, 1.0  # the other half is black; the mean is 2.25
    sigma = 0.1
    a, b = (noisy(clean, sigma, 1, seed) for seed in (1, 2))
    floor = 0.225**2
    wanted = sigma**2 * ((1 / (64 + floor) + 1 / (1 + floor)) / 4 + 0.5 / floor)
    assert relative_variance(a, b, 2) == pytest.approx(wanted, rel=0.05)
    moved = np.roll(clean, 4, axis=1)  # off the blocks, so that some hold both
    assert relative_variance(*(noisy(moved, sigma, 1, seed) for seed in (1, 2)), 2) != pytest.approx(wanted, rel=0.05)


def test_a_black_image_has_no_relative_variance() -> None:
    black = np.zeros((8, 8, 3), np.float32)
    assert relative_variance(black, black, 2) is None
    assert relative_variance(black + 1, black + 1, 2) == 0
