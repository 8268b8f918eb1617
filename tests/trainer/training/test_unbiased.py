"""Noisy targets: where they lead, and the errors measured against them. Seeds are fixed; limits are 3 σ."""

import numpy as np
import pytest
import torch

from photonfarm.core.statistics import Estimate, clean_error, group_means, noise_floor
from photonfarm.trainer.training.losses import LOSSES, linear_loss


def test_the_relative_loss_is_least_at_the_mean_of_the_noisy_targets() -> None:
    """A pixel of true mean 0.9 under rare bright targets: descent ends at their mean, not at a darker value."""
    generator = torch.Generator().manual_seed(0)
    target = torch.empty(4000, 2, 1, 1, 3).exponential_(generator=generator) ** 2 * 0.45  # mean 0.9
    pixel = torch.zeros(1, 1, 1, 3, requires_grad=True)
    for _ in range(400):
        (gradient,) = torch.autograd.grad(LOSSES["relative"](pixel.expand(4000, 1, 1, 3), target), pixel)
        pixel.data -= gradient
    torch.testing.assert_close(pixel.detach()[0], target.mean(dim=(0, 1)), atol=1e-4, rtol=0)


def test_the_error_with_the_noise_removed_is_the_error_against_the_clean_image() -> None:
    rng = np.random.default_rng(0)
    clean, prediction = (rng.random((16, 16, 3), np.float32) for _ in range(2))
    halves = [(clean * rng.gamma(0.25, 4, (2, 16, 16, 3))).astype(np.float32) for _ in range(400)]
    found = Estimate.of(np.array([clean_error(prediction, a, b) for a, b in halves]))
    truth = float(np.mean((prediction - clean) ** 2))
    assert abs(found.mean - truth) < 3 * found.standard_error
    assert found.standard_error < 0.1 * truth


def test_values_of_one_configuration_count_as_one() -> None:
    """Eight equal values each: the error is that of the 50 configurations, not of 400 samples."""
    values = np.random.default_rng(3).normal(size=50)
    found = Estimate.of(group_means(np.repeat(values, 8), list(np.repeat(np.arange(50), 8))))
    assert found.count == 50
    assert found.standard_error == pytest.approx(Estimate.of(values).standard_error)


def test_the_noise_floor_is_the_variance_of_the_target() -> None:
    rng = np.random.default_rng(2)
    clean = rng.random((16, 16, 3), np.float32)
    halves = [(clean * rng.gamma(1, 1, (2, 16, 16, 3))).astype(np.float32) for _ in range(400)]
    found = Estimate.of(np.array([noise_floor(a, b) for a, b in halves]))
    truth = Estimate.of(np.array([float(np.mean(((a + b) / 2 - clean) ** 2)) for a, b in halves]))
    assert abs(found.mean - truth.mean) < 3 * (found.standard_error + truth.standard_error)


def test_the_loss_on_both_halves_has_the_gradient_of_the_loss_on_their_mean() -> None:
    generator = torch.Generator().manual_seed(0)
    prediction = torch.randn(2, 4, 4, 3, generator=generator, requires_grad=True)
    target = torch.randn(2, 2, 4, 4, 3, generator=generator)
    both = torch.autograd.grad(linear_loss(prediction, target), prediction)[0]
    mean = torch.autograd.grad(((prediction - target.mean(dim=1)) ** 2).mean(), prediction)[0]
    torch.testing.assert_close(both, mean)
