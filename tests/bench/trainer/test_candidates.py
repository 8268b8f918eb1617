"""Networks that were tried: each is what its page says it is, and all are trained as any other."""

from __future__ import annotations

import pytest
import torch
from analytic_room import analytic_spec
from analytic_room_samples import AnalyticSource
from read_batches import batch_of
from torch import Tensor

from bench.trainer import candidates
from bench.trainer.guided_networks import CANDIDATES, INSTEAD
from photonfarm.trainer.networks import build, find_kind
from photonfarm.trainer.networks.inputs import Inputs, Needs, SceneFrame
from photonfarm.trainer.networks.lit_points import LitPoints
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs import settings

SOURCE = AnalyticSource(analytic_spec(16, 256), 2)


def made(name: str) -> Network:
    """A network of some width whose residual blocks do something, unlike at the start."""
    chosen = settings.make_settings("small", {**CANDIDATES[name], "width": 4}).network
    network = build(chosen, SceneFrame.of(SOURCE.spec, *SOURCE.base(), chosen), 0)
    torch.manual_seed(0)
    for part, parameter in network.named_parameters():
        if "blocks" in part and "out" in part:
            torch.nn.init.normal_(parameter, std=0.2)
    return network


def inputs(needs: Needs = Needs(guides=True)) -> Inputs:  # noqa: B008
    """Two samples."""
    return batch_of(SOURCE, (0, 1), needs).inputs


def image(network: Network) -> Tensor:
    with torch.no_grad():
        return network(inputs())


def layers(name: str) -> tuple[LitPoints, LitPoints]:
    """The points of `guided_transport`, and of a candidate."""
    return tuple(made(each).lit_points for each in ("guided_transport", name))


def arriving(points: LitPoints, sent: float = 0.5) -> Tensor:
    """All diffuse light where surfaces are in the middle of the room and face it."""
    torch.manual_seed(1)
    at, facing = 0.4 * torch.rand(9, 3) - 0.2, torch.nn.functional.normalize(torch.randn(9, 3), dim=-1)
    source = torch.from_numpy(SOURCE.base()[1].position)
    with torch.no_grad():
        return points.arriving(at, facing, source, torch.full((len(source), 3), sent))[1]


def form_factors(points: LitPoints) -> Tensor:
    source = torch.from_numpy(SOURCE.base()[1].position)
    with torch.no_grad():
        return points.form_factors(source[:5], points.normal[:5], source)


@pytest.mark.parametrize("name", INSTEAD)
def test_a_candidate_makes_an_image_and_all_of_its_weights_learn(name: str) -> None:
    network = made(name)
    shown = network(inputs(find_kind(CANDIDATES[name]["architecture"]).needs))
    assert shown.shape == (2, 16, 16, 3)
    assert torch.isfinite(shown).all()
    shown.square().sum().backward()
    for part, parameter in network.named_parameters():
        assert parameter.grad is not None, part
        assert torch.isfinite(parameter.grad).all(), part
        assert parameter.grad.any(), part


@pytest.mark.parametrize("name", ["OneBounce", "TwoBounces"])
def test_points_that_reflect_nothing_of_each_other_bounce_nothing(name: str) -> None:
    ours, other = made("guided_transport"), made(name)
    assert not torch.equal(image(ours), image(other))
    points = other.lit_points
    sent, at = torch.rand(256, 3), torch.rand(9, 3)
    source = torch.from_numpy(SOURCE.base()[1].position)
    points.albedo = torch.zeros_like(points.albedo)
    with torch.no_grad():
        alike = [layer.arriving(at, at, source, sent)[1] for layer in (ours.lit_points, points)]
    assert torch.equal(*alike), "a seed gives both the same weights"


def test_the_second_bounce_is_less_than_the_first() -> None:
    none, one = map(arriving, layers("OneBounce"))
    two = arriving(layers("TwoBounces")[1])
    assert (none < one).all()
    assert (one < two).all()
    assert (two - one < one - none).all()


def test_where_nothing_is_hidden_all_is_as_where_all_is_learned_to_be_seen() -> None:
    ours, unhidden = layers("Unhidden")
    with torch.no_grad():
        ours.visibility.open.fill_(50.0)
    torch.testing.assert_close(arriving(unhidden), arriving(ours))
    assert not list(unhidden.parameters())


def test_attention_gives_weights_of_sum_1() -> None:
    _, attention = layers("Attention")
    found = form_factors(attention)
    torch.testing.assert_close(found.sum(dim=1), torch.ones(5))
    assert (found.amax(dim=1) < 1).all()


def test_tokens_read_points_in_any_order() -> None:
    _, points = layers("LatentTokens")
    at, source, sent = torch.rand(9, 3), torch.from_numpy(SOURCE.base()[1].position), torch.rand(256, 3)
    order = torch.randperm(256)
    with torch.no_grad():
        before = points.arriving(at, at, source, sent)[1]
        dark = points.arriving(at, at, source, 0 * sent)[1]
        points.normal, points.albedo = points.normal[order], points.albedo[order]
        after = points.arriving(at, at, source[order], sent[order])[1]
    torch.testing.assert_close(after, before)
    assert (dark != before).all()
    assert (before > 0).all()


def test_the_maximum_beside_guides_is_that_of_light_transport() -> None:
    """The same features from the same weights, in a network that adds what guided ones add."""
    beside, alone = made("MaximumBeside"), made("light_transport")
    weights = {part: value for part, value in alone.state_dict().items() if "image_synthesis" not in part}
    assert not beside.load_state_dict(weights, strict=False).unexpected_keys
    given = inputs()
    (found,), (expected,) = beside.further(given), alone.further(given)
    assert torch.equal(found, expected)
    assert torch.equal(beside.known(given, []), given.guides.emission + given.guides.direct + given.guides.gloss)


def test_pixels_without_a_point_are_filled_from_near_ones_and_others_left() -> None:
    filled, ours = made("FilledProjection"), made("light_transport")
    given = inputs()
    points = given.points
    there = ours.project(torch.ones(2, 256, 1), points.position, points.present, points.seen, given)[..., 0] > 0
    features = torch.rand(2, 256, 8)
    one, other = (
        each.project(features, points.position, points.present, points.seen, given) for each in (filled, ours)
    )
    assert torch.equal(one[there], other[there])
    assert 0 < there.float().mean() < 0.9
    constant = filled.project(torch.full((2, 256, 1), 0.7), points.position, points.present, points.seen, given)
    near = torch.nn.functional.max_pool2d(there.float()[:, None], 2 * candidates.REACH + 1, 1, candidates.REACH)[:, 0]
    torch.testing.assert_close(constant[..., 0], 0.7 * near)
