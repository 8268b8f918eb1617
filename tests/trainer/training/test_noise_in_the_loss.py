"""The noise that `scene plan --for training` weighs is what the relative loss of a perfect network is."""

import numpy as np
import pytest
import torch

from photonfarm.renderer.strategy.noise import LOSS_EPSILON, pair_errors, training_weights
from photonfarm.trainer.runs.settings import make_preset
from photonfarm.trainer.training.losses import RELATIVE_EPSILON, relative_loss

SIDE, EXPOSURE, HALVES = 64, 2.5, 16


def test_the_renderer_knows_the_default_loss() -> None:
    assert make_preset("small").loss == "relative"
    assert LOSS_EPSILON == RELATIVE_EPSILON


def test_noise_weighed_for_training_is_the_relative_loss_of_the_noise_free_image() -> None:
    """A picture that gets brighter from the left to the right, four decades, with noise in proportion.

    Both sides have the same noise, once as differences of two halves, once as differences from the truth. They differ
    by the product of two halves' noise: 1.4 times its standard error, 1/√n of n values, of which some thousand bright
    ones count, so about 2 %. The weights hold 3 × 3 pixels, in which the brighter ones add 1 %.
    """
    rng = np.random.default_rng(0)
    truth = np.broadcast_to(np.logspace(-3, 1, SIDE)[None, :, None], (SIDE, SIDE, 3)) * np.array([0.5, 1.0, 2.0])
    halves = (truth * (1 + 0.5 * rng.standard_normal((HALVES, *truth.shape)))).astype(np.float32)
    weights = training_weights([truth.astype(np.float32)] * 2, EXPOSURE)
    assert weights is not None
    pairs = [pair_errors([(a, b)], weights)[0][0] for a, b in zip(halves[::2], halves[1::2], strict=True)]
    targets = torch.from_numpy(EXPOSURE * halves).reshape(HALVES // 2, 2, SIDE, SIDE, 3)
    prediction = torch.from_numpy(EXPOSURE * truth).float().expand(HALVES // 2, SIDE, SIDE, 3)
    assert np.mean(pairs) == pytest.approx(float(relative_loss(prediction, targets)), rel=0.06)
