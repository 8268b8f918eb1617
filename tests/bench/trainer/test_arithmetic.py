"""Rounding to TF32, by hand and against torch's own gradients; what is concluded from differences of gradients."""

import pytest
import torch
from torch.nn import functional

from bench.trainer.arithmetic import GradientDifference, Trained, bias_section
from bench.trainer.rounded_convolutions import RoundedConv2d, round_factors, rounded


def test_values_are_rounded_to_ten_bits_ties_to_even() -> None:
    step = 2.0**-10
    given = torch.tensor([1 + step / 2, 1 + step, 1 + 1.5 * step, 1 + 0.51 * step, -3.0, 0.0])
    wanted = torch.tensor([1.0, 1 + step, 1 + 2 * step, 1 + step, -3.0, 0.0])
    assert torch.equal(rounded(given), wanted)
    x = torch.randn(10_000, generator=torch.Generator().manual_seed(0))
    assert 2.0**-12 < ((rounded(x) - x) / x).abs().max() <= 2.0**-11


def test_a_rounded_convolution_has_the_gradients_of_rounded_factors() -> None:
    torch.manual_seed(0)
    plain = torch.nn.Conv2d(3, 4, 3, padding=1)
    x, above = torch.randn(2, 3, 8, 8, requires_grad=True), torch.randn(2, 4, 8, 8)
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3, padding=1))
    network[0].load_state_dict(plain.state_dict())
    round_factors(network)
    assert isinstance(network[0], RoundedConv2d)
    out = network(x)
    (out * above).sum().backward()
    twin_x, twin_weight = (rounded(t.detach()).requires_grad_() for t in (x, plain.weight))
    wanted = functional.conv2d(twin_x, twin_weight, plain.bias, padding=1)
    assert torch.equal(out, wanted)
    of_x, of_weight = torch.autograd.grad((wanted * rounded(above)).sum(), (twin_x, twin_weight))
    torch.testing.assert_close(x.grad, of_x)
    torch.testing.assert_close(network[0].weight.grad, of_weight)
    torch.testing.assert_close(network[0].bias.grad, above.sum(dim=(0, 2, 3)))


@pytest.mark.parametrize("brighter", [0.02, -0.01])
def test_the_page_says_how_much_brighter_a_precision_is(brighter: float) -> None:
    difference = {name: GradientDifference(0.01, 0.002, 0.1) for name in ("tf32", "bfloat16")}
    found = [
        Trained(
            {"float32": base, "tf32": base, "bfloat16": base * (1 + brighter + off)},
            {"float32": 0.1, "tf32": 0.1, "bfloat16": 0.1},
            {"tf32": 0.0, "bfloat16": 0.01},
            {"first": difference, "last": difference},
        )
        for base, off in ((1.0, 0.001), (1.1, -0.001))
    ]
    page = bias_section(found, 10)
    low, high = (brighter + side * 12.7062 * 0.001 for side in (-1, 1))  # Student's t of one degree of freedom
    assert f"{brighter:+.2%} ({low:+.2%} … {high:+.2%})" in page
    assert page.count("1/50") == 4
