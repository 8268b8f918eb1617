"""Which light path an eye path is joined to, before the shift."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.launches import Lanes, Launch
from photonfarm.renderer.bdpt.randomness import places

WIDTH, HEIGHT = 16, 8
PIXELS = WIDTH * HEIGHT


def partners(samples: int, light_paths: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Any:
    """[samples, pixels]: the numbers of the light paths."""
    launch = Launch(1, 0, samples, 0, light_paths, 0)
    lanes = Lanes.of(launch, size, samples, mi.UInt32(7), None)
    _, sample, pixel = lanes.eye()
    joined = np.zeros((samples, lanes.pixels), np.int64)
    found = lanes.partner(sample, places(lanes.keys, sample, pixel))
    joined[np.array(sample), np.array(pixel)] = np.array(found)
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
    if samples > 1:
        within = (joined % share + 0.5) / share  # the place differs from share to share
        spread = within.var(axis=0, ddof=1).mean()
        assert spread == pytest.approx(1 / 12, rel=0.2)


def test_light_paths_are_used_about_equally_often_in_images_of_any_size() -> None:
    used = np.bincount(partners(8, 8 * 937, (100, 75)).ravel(), minlength=8 * 937)
    assert len(used) == 8 * 937
    assert used.std() < 1.5  # independent places would give 2.8


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (100, 75)], ids=str)
@pytest.mark.parametrize("light_ratio", [0.0625, 0.125, 1.0, 4.0])
def test_no_offset_joins_pixels_to_close_light_paths(size: tuple[int, int], light_ratio: float) -> None:
    """Light paths close in a share start alike; pixels joined to them at some offset would show as a pattern."""
    width, height = size
    share = round(width * height * light_ratio)
    turns = (partners(4, 4 * share, size).reshape(4, height, width) % share) / share
    for harmonic in (1, 2):  # the second also sees half of the pairs close and half of them opposite
        on_circle = np.exp(2j * np.pi * harmonic * turns)
        for x, y in ((x, y) for y in range(9) for x in range(-16, 17) if y or x > 0):
            from_, to = (slice(max(0, -x), width - max(0, x)), slice(max(0, x), width - max(0, -x)))
            close = (on_circle[:, y:, to] * on_circle[:, : height - y, from_].conj()).mean().real
            assert close < 0.12, f"pixels at an offset of ({x}, {y})"


def test_places_differ_from_image_to_image_and_from_sample_to_sample() -> None:
    pixel = dr.arange(mi.UInt32, 64)
    one, image, sample = (
        np.array(places(mi.UInt32(key), mi.UInt32(number), pixel)) for key, number in ((7, 0), (8, 0), (7, 1))
    )
    assert (one != image).mean() > 0.9
    assert (one != sample).mean() > 0.9
