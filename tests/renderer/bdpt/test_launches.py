"""Which light path an eye path is joined to, before the shift."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.launches import Lanes, Launch

WIDTH, HEIGHT = 16, 8
PIXELS = WIDTH * HEIGHT


def partners(samples: int, light_paths: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Any:
    """[samples, pixels]: the numbers of the light paths."""
    launch = Launch(1, 0, samples, 0, light_paths, 0)
    lanes = Lanes.of(launch, size, samples, mi.UInt32(0), None)
    _, sample, pixel = lanes.eye()
    joined = np.zeros((samples, lanes.pixels), np.int64)
    joined[np.array(sample), np.array(pixel)] = np.array(lanes.partner(sample, pixel))
    return joined


@pytest.mark.parametrize("samples", [1, 7, 8, 64])
@pytest.mark.parametrize("light_ratio", [0.0625, 0.25, 1.0, 4.0])
def test_samples_of_a_pixel_are_joined_to_light_paths_from_everywhere(samples: int, light_ratio: float) -> None:
    paths = round(samples * PIXELS * light_ratio)
    joined = partners(samples, paths)
    assert joined.max() < paths
    share = paths / samples
    np.testing.assert_array_equal(
        np.sort(joined // share, axis=0), np.broadcast_to(np.arange(samples)[:, None], joined.shape)
    )
    within = (joined % share) / share
    if samples > 1:
        assert (np.ptp(within, axis=0) >= 0.5).all()  # not at the same place of each share


@pytest.mark.parametrize("light_ratio", [0.0625, 0.25, 1.0])
def test_light_paths_are_used_equally_often(light_ratio: float) -> None:
    used = np.bincount(partners(8, round(8 * PIXELS * light_ratio)).ravel())
    assert (used == 1 / light_ratio).all()


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (256, 256), (100, 75)], ids=str)
@pytest.mark.parametrize("light_ratio", [0.125, 0.25, 1.0, 4.0])
def test_neighbours_take_slots_far_apart(size: tuple[int, int], light_ratio: float) -> None:
    """Along rows and along columns: light paths of close slots start alike, and noise in common is seen as streaks."""
    width, height = size
    share = round(width * height * light_ratio)
    joined = partners(2, 2 * share, size).reshape(2, height, width)
    for axis, farthest, least in ((2, 8, 0.02), (1, 3, 0.04)):
        for distance in range(1, farthest + 1):
            far, near = np.split(joined, [distance], axis)[1], np.split(joined, [-distance], axis)[0]
            apart = (far - near) % share
            assert np.minimum(apart, share - apart).min() >= least * share


def test_there_may_be_fewer_light_paths_than_samples() -> None:
    joined = partners(8, 3)
    assert (joined == np.arange(8)[:, None]).all()  # the shift's modulus brings them below 3
