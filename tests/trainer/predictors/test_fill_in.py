"""Dropped pixels filled in: exact where theory says so, equal to the formula written out, whatever else is there."""

import numpy as np
import pytest
import torch
from torch import Tensor

from photonfarm.trainer.networks.inputs import NoisyColour
from photonfarm.trainer.predictors.denoisers import LEAST_ALBEDO, REACH, SPREAD, fill_in


def dropped(colour: Tensor, of: int, seed: int = 0) -> NoisyColour:
    """One of `of` pixels of each image, (B, H, W, 3), kept at random."""
    order = torch.rand(colour.shape[:3], generator=torch.Generator().manual_seed(seed)).flatten(1).argsort(dim=1)
    kept = (order < order.shape[1] // of).reshape(colour.shape[:3])
    return NoisyColour(colour * kept[..., None], kept)


def random(*shape: int, seed: int = 1) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("of", [4, 16, 64])
def test_a_constant_image_of_constant_albedo_comes_out_exact(of: int) -> None:
    colour = torch.tensor([3.0, 0.2, 40.0]).expand(2, 24, 32, 3)
    albedo = torch.tensor([0.8, 0.1, 0.0]).expand(2, 24, 32, 3)
    assert torch.allclose(fill_in(dropped(colour, of), albedo), colour, rtol=1e-5)


@pytest.mark.parametrize("of", [4, 16, 64])
def test_light_on_a_texture_comes_out_exact_where_the_light_is_constant(of: int) -> None:
    albedo = LEAST_ALBEDO + 0.9 * random(2, 24, 32, 3)
    albedo[:, 5:9, :, 1] = 0  # what is black reflects nothing
    colour = albedo * torch.tensor([2.0, 1.0, 7.0])
    assert torch.allclose(fill_in(dropped(colour, of), albedo), colour, rtol=1e-4, atol=1e-6)


def test_kept_pixels_stay_as_they_are_and_nothing_else_is_seen() -> None:
    albedo, colour = random(1, 16, 16, 3), 5 * random(1, 16, 16, 3, seed=2)
    noisy = dropped(colour, 4)
    filled = fill_in(noisy, albedo)
    assert torch.equal(filled[noisy.kept], colour[noisy.kept])
    assert torch.isfinite(filled).all()
    assert torch.equal(fill_in(dropped(colour, 1), albedo), colour)


def test_a_dropped_pixel_is_what_the_formula_says() -> None:
    """The formula written out for each pixel; the Gaussian is wide enough that one round does."""
    albedo, colour = random(1, 9, 11, 3), 5 * random(1, 9, 11, 3, seed=2)
    albedo[:, 3:6, 2:7] = 0
    noisy = dropped(colour, 2)
    filled, kept = fill_in(noisy, albedo)[0].numpy(), noisy.kept[0].numpy()
    sigma = SPREAD / np.sqrt(kept.mean())
    reach = int(np.ceil(REACH * sigma))
    a, c = (x[0].numpy().astype(np.float64) for x in (albedo, colour))
    d = np.where(a >= LEAST_ALBEDO, a, 1)
    for y, x in np.argwhere(~kept):
        for channel in range(3):
            light = surface = 0.0
            for v, u in np.argwhere(kept):
                near = max(abs(v - y), abs(u - x)) <= reach
                if near and (a[v, u, channel] >= LEAST_ALBEDO) == (a[y, x, channel] >= LEAST_ALBEDO):
                    weight = np.exp(-((v - y) ** 2 + (u - x) ** 2) / (2 * sigma**2))
                    light += weight * c[v, u, channel]
                    surface += weight * d[v, u, channel]
            assert surface > 0, "another seed is needed"
            assert filled[y, x, channel] == pytest.approx(d[y, x, channel] * light / surface, rel=1e-4)


def test_one_kept_pixel_fills_a_whole_image_also_one_of_another_kind_and_none_leaves_it_black() -> None:
    kept = torch.zeros(3, 8, 40, dtype=torch.bool)
    kept[0, 0, 0] = kept[1, 0, 0] = True
    colour = kept[..., None] * torch.tensor([1.0, 2.0, 3.0])
    albedo = torch.full((3, 8, 40, 3), 0.5)
    albedo[1, :, 1:] = 0
    filled = fill_in(NoisyColour(colour, kept), albedo)
    assert torch.allclose(filled[0], torch.tensor([1.0, 2.0, 3.0]).expand(8, 40, 3))
    assert torch.allclose(filled[1], torch.tensor([1.0, 2.0, 3.0]).expand(8, 40, 3))
    assert not filled[2].any()
