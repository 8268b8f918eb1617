"""Noisy targets: the gradient they give, and the errors measured against them. Seeds are fixed; limits are 3 σ."""

import numpy as np
import pytest
import torch

from photonfarm.shared.estimate import Estimate, clean_error, group_means, noise_floor
from photonfarm.trainer.dataset import Batch, Compact, fill
from photonfarm.trainer.losses import LOSSES, linear_loss
from photonfarm.trainer.model import SceneFrame, build
from photonfarm.trainer.settings import NetworkSettings


@pytest.mark.parametrize("loss", sorted(LOSSES))
def test_averaged_over_noisy_targets_the_gradient_is_the_clean_one(make_source, loss: str) -> None:
    """Lemma 1 [supplement 3.2], along 16 random directions in the space of all weights."""
    source = make_source(1)
    settings = NetworkSettings(width=4)
    network = build(settings, SceneFrame.of(source.spec, *source.base(), settings), 0)
    batch = Batch.empty(1, 256, source.spec)
    fill(batch, 0, Compact.of(source.read(0), source.spec), source.spec, source.base()[1])
    weights = list(network.parameters())
    generator = torch.Generator().manual_seed(0)
    directions = [[torch.randn(p.shape, generator=generator) for p in weights] for _ in range(16)]

    def along(target: np.ndarray) -> list[float]:
        value = LOSSES[loss](network(batch.inputs), torch.from_numpy(target)[None])
        gradient = torch.autograd.grad(value, weights)
        return [sum(float((g * d).sum()) for g, d in zip(gradient, way, strict=True)) for way in directions]

    clean = source.clean(0)
    wanted = along(np.stack([clean, clean]))
    rng = np.random.default_rng(1)
    found = np.array([along((clean * rng.gamma(0.5, 2, (2, *clean.shape))).astype(np.float32)) for _ in range(200)])
    z = (found.mean(axis=0) - wanted) / (found.std(axis=0, ddof=1) / np.sqrt(len(found)))
    assert np.abs(z).max() < 3
    assert np.abs(found.std(axis=0) / wanted).max() > 0.05, "the noise is large enough for a bias to show"


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
