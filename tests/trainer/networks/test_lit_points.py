"""Light that points of a closed surface send on: inside a sphere all of it is known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from photonfarm.core.records import LIT_POINTS
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.lit_points import LitPoints
from photonfarm.trainer.networks.projection import Optics

POINTS, ALBEDO, SENT = 1024, 0.6, 0.3


def frame_of(points: int) -> SceneFrame:
    """The frame of a sphere of radius 1 that faces inwards."""
    number = np.arange(points) + 0.5
    z, angle = 1 - 2 * number / points, math.pi * (1 + 5**0.5) * number
    ring = np.sqrt(1 - z * z)
    position = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1).astype(np.float32)
    appearance = np.concatenate([-position, np.full((points, 3), ALBEDO), np.zeros((points, 3))], axis=1)
    optics = Optics(16.0, 16, 16, 0.01, 10.0)
    centre, area = np.zeros(3, np.float32), 4 * math.pi
    return SceneFrame(optics, centre, 1.0, position, appearance.astype(np.float32), 0, 1.0, -1, area)


@pytest.fixture
def sphere() -> tuple[LitPoints, Tensor]:
    """Points of that sphere, with weights that are the same each time, and where they are, (1, L, 3)."""
    torch.manual_seed(0)
    frame = frame_of(POINTS)
    return LitPoints(frame, POINTS), torch.from_numpy(frame.base)[None]


def surfaces() -> tuple[Tensor, Tensor]:
    """Places well inside, and where they face, (1, 8, 8, 3), the same for each square of pixels."""
    torch.manual_seed(0)
    place, facing = 0.6 * torch.rand(2, 2, 3) - 0.3, torch.randn(2, 2, 3)
    return tuple(each.repeat_interleave(4, 0).repeat_interleave(4, 1)[None] for each in (place, facing))


def diffuse(layer: LitPoints, position: Tensor) -> tuple[Tensor, Tensor]:
    sent = torch.full((1, POINTS, 3), SENT)
    return layer._diffuse(*surfaces(), position, sent)


def test_a_closed_surface_that_sends_the_same_everywhere_is_seen_so_from_everywhere(sphere) -> None:
    unhidden, _ = diffuse(*sphere)
    torch.testing.assert_close(unhidden, torch.full((1, 8, 8, 3), SENT), rtol=0.02, atol=0)


def test_where_nothing_is_hidden_all_light_comes(sphere) -> None:
    layer, position = sphere
    with torch.no_grad():
        layer.visibility.open.fill_(50.0)
    _, light = diffuse(layer, position)
    torch.testing.assert_close(light, torch.full((1, 8, 8, 3), SENT), rtol=0.02, atol=0)


def test_where_all_is_hidden_no_light_comes_and_what_is_not_there_sends_none(sphere) -> None:
    layer, position = sphere
    with torch.no_grad():
        layer.visibility.open.fill_(-50.0)
    unhidden, light = diffuse(layer, position)
    assert light.max() < 1e-6 < unhidden.min()
    dark = layer._diffuse(*surfaces(), position, torch.zeros(1, POINTS, 3))
    assert all(each.max() == 0 for each in dark)


def lobe(layer: LitPoints, position: Tensor, roughness: float, sent: Tensor) -> Tensor:
    """What a metal at the sphere's centre shows that is seen along its normal (0, 0, 1), (3,)."""
    normal = torch.tensor([[[0.0, 0.0, 1.0]]])
    return layer._lobes(torch.zeros(1, 1, 3), normal, -normal, torch.full((1, 1, 1), roughness), position, sent)[0, 0]


def test_a_lobe_shows_the_light_that_is_the_same_everywhere(sphere) -> None:
    sent = torch.full((1, POINTS, 3), SENT)
    for roughness in (0.0, 0.1, 0.5, 1.0):
        torch.testing.assert_close(lobe(*sphere, roughness, sent), torch.full((3,), SENT))


@pytest.mark.parametrize("roughness", [0.1, 0.2, 0.3])
def test_a_lobe_is_as_wide_as_light_that_a_rough_metal_reflects(sphere, roughness: float) -> None:
    """Its mean cosine is that of a ray that Beckmann's normals mirror, drawn by eq. 28 of Walter et al. (2007)."""
    layer, position = sphere
    found = lobe(layer, position, roughness, position[..., 2:].expand(-1, -1, 3))
    drawn = np.random.default_rng(0).random(100_000)
    slope = roughness * np.sqrt(-np.log1p(-drawn))  # tan of a normal's angle
    assert 1 - found[0] == pytest.approx(1 - np.cos(2 * np.arctan(slope)).mean(), rel=0.2)


def test_points_that_turned_send_as_those_whose_base_stands_so(sphere) -> None:
    """Each turned half around as in the base sends outwards, so nothing arrives; turned back, all does."""
    layer, position = sphere
    frame = frame_of(POINTS)
    turned = LitPoints(replace(frame, appearance=-frame.appearance), POINTS)
    turned.load_state_dict(layer.state_dict())
    inwards = torch.cat([position, layer.normal[None]], dim=-1)
    for found, expected in zip(diffuse(turned, inwards), diffuse(layer, position), strict=True):
        torch.testing.assert_close(found, expected)
    assert all(light.max() < 1e-6 for light in diffuse(turned, position))
    sent = position[..., 2:].expand(-1, -1, 3)
    torch.testing.assert_close(lobe(turned, inwards, 0.2, sent), lobe(layer, position, 0.2, sent))


def test_more_points_than_are_lit_are_not_asked_for() -> None:
    assert LitPoints(frame_of(LIT_POINTS + 1), LIT_POINTS + 1).albedo.shape == (LIT_POINTS, 3)


def test_a_wall_between_is_learned(sphere) -> None:
    """The half of the sphere below is dark to whoever is above: by 60 steps most of its light is gone."""
    layer, position = sphere
    torch.manual_seed(1)
    above = 0.3 * torch.rand(1, 8, 8, 3) + torch.tensor([-0.15, -0.15, 0.2])
    facing = torch.tensor([0.0, 0.0, -1.0]).expand(1, 8, 8, 3)
    sent = SENT * (position[..., 2:] < 0).float().expand(-1, -1, 3)
    optimiser = torch.optim.Adam(layer.parameters(), lr=3e-2)
    for _ in range(60):
        optimiser.zero_grad()
        unhidden, light = layer._diffuse(above, facing, position, sent)
        light.square().mean().backward()
        optimiser.step()
    assert all(parameter.grad is not None for parameter in layer.parameters())
    assert light.mean() < 0.1 * unhidden.mean()
