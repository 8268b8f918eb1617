"""The layers: sizes, invariances, masks, precision."""

import torch
from torch.nn import functional

from photonfarm.trainer.networks.network import ImageSynthesisLayer
from photonfarm.trainer.networks.paper_networks import LightTransportLayer, masked_max


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def layer(seed: int = 0) -> LightTransportLayer:
    """A layer whose last weights are not zero, unlike at the start."""
    torch.manual_seed(seed)
    made = LightTransportLayer(3, 6)
    for block in made.blocks:
        torch.nn.init.normal_(block.out.weight)
        torch.nn.init.normal_(block.out.bias)
    return made


def as_drawn(made: LightTransportLayer, points: torch.Tensor, present: torch.Tensor) -> torch.Tensor:
    """Figure 1 taken literally: every point carries its features and the maximum, 64 wide, into the next block."""
    x = made.preprocess(points)
    for block in made.blocks:
        hidden = block.hidden(functional.relu(x))
        local = block.shortcut(x) + block.out(functional.relu(hidden))
        maximum = local.masked_fill(~present[..., None], -torch.inf).amax(dim=1, keepdim=True)
        x = torch.cat([local, maximum.expand_as(local)], dim=2)
    return x


def test_the_light_transport_layer_is_the_one_of_figure_1() -> None:
    made = layer().double()
    assert parameters(made) == (9 * 64 + 64) + 2 * (64 * 32 + 32 + 32 * 32 + 32 + 64 * 32)
    varying, fixed, present = torch.randn(2, 50, 3).double(), torch.randn(50, 6).double(), torch.rand(2, 50) < 0.7
    found = made(varying, fixed, present)
    assert found.shape == (2, 50, 64)
    torch.testing.assert_close(found, as_drawn(made, torch.cat([varying, fixed.expand(2, -1, -1)], dim=2), present))


def test_relative_maxima_are_less_those_of_the_reference() -> None:
    made = layer().double()
    varying, fixed, present = torch.randn(3, 50, 3).double(), torch.randn(50, 6).double(), torch.rand(3, 50) < 0.7
    present[2] = False
    reference, all_present = torch.randn(50, 3).double(), torch.ones(1, 50, dtype=torch.bool)
    both = torch.cat([torch.cat([varying, reference[None]]), fixed.expand(4, -1, -1)], dim=2)
    x = made.preprocess(both)
    for block in made.blocks:
        local = block.shortcut(x) + block.out(functional.relu(block.hidden(functional.relu(x))))
        maximum = masked_max(local, torch.cat([present, all_present]))
        relative = (maximum - maximum[3]) * torch.tensor([1, 1, 0, 1])[:, None]  # zero where no point is present
        x = torch.cat([local, relative[:, None].expand_as(local)], dim=2)
    found = made(varying, fixed, present, reference)
    torch.testing.assert_close(found, x[:3])
    assert not found[2, :, 32:].any()
    at_base = made(reference[None], fixed, all_present, reference)
    assert not at_base[..., 32:].any()


def test_constants_of_each_sample_are_those_of_all_where_they_are_the_same() -> None:
    made = layer().double()
    varying, fixed, present = torch.randn(3, 50, 3).double(), torch.randn(50, 6).double(), torch.rand(3, 50) < 0.7
    torch.testing.assert_close(made(varying, fixed.expand(3, -1, -1), present), made(varying, fixed, present))
    reference = torch.randn(50, 3).double()
    of_all, of_each = (made(varying, each, present, reference) for each in (fixed, fixed.expand(4, -1, -1)))
    torch.testing.assert_close(of_each, of_all)
    other = torch.cat([fixed.expand(2, -1, -1), fixed[None] + 1, fixed[None]])
    torch.testing.assert_close(made(varying, other, present, reference)[:2], of_all[:2])
    assert (made(varying, other, present, reference)[2] - of_all[2]).abs().max() > 0.1


def test_features_of_size_one_stay_so_before_any_step() -> None:
    """Features would shrink from torch's own start with each layer, far below the U-Net's other channels."""
    torch.manual_seed(0)
    found = LightTransportLayer(3, 6)(torch.randn(2, 500, 3), torch.randn(500, 6), torch.ones(2, 500, dtype=torch.bool))
    assert 0.8 < found[..., :32].std() < 2.5


def test_absent_points_never_leak_into_present_ones() -> None:
    made = layer()
    varying, fixed, present = torch.randn(2, 50, 3), torch.randn(50, 6), torch.rand(2, 50) < 0.7
    louder = torch.where(present[..., None], varying, 1e4)  # would win every maximum
    assert torch.equal(made(louder, fixed, present)[present], made(varying, fixed, present)[present])


def test_the_maximum_over_no_present_point_is_zero() -> None:
    x = torch.randn(2, 5, 4)
    present = torch.tensor([[False] * 5, [True, False, True, False, False]])
    found = masked_max(x, present)
    assert torch.equal(found[0], torch.zeros(4))
    assert torch.equal(found[1], torch.maximum(x[1, 0], x[1, 2]))


def test_in_bfloat16_the_image_is_nearly_the_same_and_stays_float32() -> None:
    torch.manual_seed(0)
    plain, short = ImageSynthesisLayer(7, 8), ImageSynthesisLayer(7, 8, "bfloat16")
    short.load_state_dict(plain.state_dict())
    x = torch.randn(2, 7, 16, 16)
    wanted, found = plain(x), short(x)
    assert found.dtype == torch.float32
    difference = (found - wanted).square().mean().sqrt() / wanted.std()
    assert 0 < difference < 0.02
    found.square().mean().backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in short.parameters())
