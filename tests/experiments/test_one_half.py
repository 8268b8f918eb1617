"""A half of a held-out view from more and more of its passes."""

import numpy as np
import torch

from experiments.one_half import HeldOutView


def test_a_half_of_more_passes_is_their_mean_and_knows_its_noise() -> None:
    given = 1 + 0.5 * torch.randn(64, 32, 32, 1, generator=torch.Generator().manual_seed(0)).expand(-1, -1, -1, 3)
    view = HeldOutView(0, given, (np.ones((32, 32, 3), np.float32),) * 2)
    one, many = view.half(1), view.half(16)
    assert torch.equal(one.colour[0], given[0])
    assert (float(one.passes), float(many.passes)) == (1, 16)
    torch.testing.assert_close(many.colour[0], given[:16].mean(dim=0))
    assert abs(float(many.variance.mean()) / (0.25 / 16) - 1) < 0.05
    assert abs(float((many.colour - 1).square().mean()) / (0.25 / 16) - 1) < 0.2
