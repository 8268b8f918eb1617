"""The network of every architecture: what it sees and what it does not, order, weights."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import read_batches
import torch

from photonfarm.core.errors import SpecError
from photonfarm.core.records import Photons, arrays_of
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.inputs import Inputs, SceneFrame, map_tensors
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import Architecture, NetworkSettings

PHOTONS = "light_transport_photons"
EVERY = sorted(ARCHITECTURES)
WITH_POINTS = ["feature_projection", "light_transport", PHOTONS]


def batch_of(source, rows: tuple[int, ...], kind: str = "light_transport") -> TrainingBatch:
    return read_batches.batch_of(source, rows, ARCHITECTURES[kind].needs)


def network(source, kind: str = "light_transport", seed: int = 0, **settings: object) -> Network:
    """A network whose residual blocks do something, unlike at the start."""
    chosen = NetworkSettings(**{"width": 4, "architecture": kind, **settings})
    made = build(chosen, SceneFrame.of(source.spec, *source.base(), chosen), seed)
    torch.manual_seed(seed)
    for name, parameter in made.named_parameters():
        if "blocks" in name and "out" in name:
            torch.nn.init.normal_(parameter, std=0.2)
    return made


def image(made: Network, inputs: Inputs) -> torch.Tensor:
    with torch.no_grad():
        return made(inputs)


def same(one: torch.Tensor, other: torch.Tensor) -> None:
    torch.testing.assert_close(one, other, atol=2e-5, rtol=1e-4)


def test_every_architecture_of_the_settings_is_registered() -> None:
    assert set(ARCHITECTURES) == set(get_args(Architecture))


@pytest.mark.parametrize("architecture", EVERY)
def test_a_batch_gives_what_its_samples_give_one_by_one(make_source, architecture: str) -> None:
    source = make_source(3, photons=64)
    made = network(source, architecture)
    together = image(made, batch_of(source, (0, 1, 2), architecture).inputs)
    alone = torch.cat([image(made, batch_of(source, (row,), architecture).inputs) for row in range(3)])
    assert together.shape == (3, 16, 16, 3)
    same(together, alone)


@pytest.mark.parametrize("architecture", EVERY)
def test_every_weight_gets_a_gradient(make_source, architecture: str) -> None:
    source = make_source(12, photons=64)
    made = network(source, architecture)
    made(batch_of(source, tuple(range(12)), architecture).inputs).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in made.parameters())


@pytest.mark.parametrize("architecture", EVERY)
def test_nothing_is_read_that_is_not_needed(make_source, architecture: str) -> None:
    needs = ARCHITECTURES[architecture].needs
    inputs = batch_of(make_source(1, photons=4), (0,), architecture).inputs
    there = [each is not None for each in (inputs.points, inputs.photons, inputs.noisy, inputs.guides)]
    assert there == [needs.points, needs.photons, bool(needs.kept), needs.guides]


@pytest.mark.parametrize("architecture", [name for name in EVERY if name.startswith("guided")])
def test_what_reflects_nothing_shows_what_it_emits_and_nothing_else(make_source, architecture: str) -> None:
    """A lamp, or a window at night: the left half of the image; the other half is learned."""
    source = make_source(1, photons=64)
    inputs = batch_of(source, (0,), architecture).inputs
    left = (slice(None), slice(None), slice(None, 8))
    for what in (inputs.albedo, inputs.guides.specular, inputs.guides.throughput):
        what[left] = 0
    inputs.guides.direct[left], inputs.guides.gloss[left] = 0, 0
    made = image(network(source, architecture), inputs)
    torch.testing.assert_close(made[left], inputs.guides.emission[left])
    assert not torch.isclose(made, inputs.guides.emission).all()


def test_direct_light_loses_noise_and_keeps_its_edges_by_a_setting(make_source) -> None:
    """Two walls, of which the left one is lit, with noise, and a black lamp on it; before anything is learned."""
    source, kind = make_source(1), "guided"
    inputs = batch_of(source, (0,), kind).inputs
    guides, lamp = inputs.guides, (slice(None), slice(6, 9), slice(2, 5))
    for values, value in ((inputs.albedo, 0.5), (inputs.depth, 1), (guides.specular, 0), (guides.gloss, 0)):
        values[:] = value
    guides.throughput[:], guides.emission[:], guides.direct[:] = 0, 0, 0.01
    inputs.normal[:, :, :8], inputs.normal[:, :, 8:] = (
        inputs.world_to_camera[0, 2, :3],
        inputs.world_to_camera[0, 0, :3],
    )
    noise = torch.randn(guides.direct.shape, generator=torch.Generator().manual_seed(0))
    guides.direct[:, :, :8] = 1 + 0.2 * noise[:, :, :8]
    inputs.albedo[lamp], guides.direct[lamp], guides.emission[lamp] = 0, 0, 7
    made = network(source, kind, filter_direct=True)
    torch.nn.init.zeros_(made.image_synthesis.out.weight)
    torch.nn.init.zeros_(made.image_synthesis.out.bias)
    filtered = image(made, inputs)
    lit = (slice(None), slice(9, 16), slice(0, 7))
    assert filtered[lit].std() < 0.6 * guides.direct[lit].std()
    torch.testing.assert_close(filtered[lit].mean(), guides.direct[lit].mean(), rtol=0.03, atol=0)
    torch.testing.assert_close(filtered[lamp], guides.emission[lamp])
    torch.testing.assert_close(filtered[:, :, 8:], guides.direct[:, :, 8:], rtol=0, atol=0.01)


@pytest.mark.parametrize("architecture", [name for name in EVERY if name.startswith("guided")])
def test_black_surfaces_that_shine_have_learned_light_by_a_setting(make_source, architecture: str) -> None:
    """Black glass in the upper left quarter, whose reflection the guides have missed; a matt black surface below."""
    source = make_source(1, photons=64)
    inputs = batch_of(source, (0,), architecture).inputs
    left, glass = (slice(None), slice(None), slice(None, 8)), (slice(None), slice(None, 8), slice(None, 8))
    for what in (inputs.albedo, inputs.guides.specular, inputs.guides.throughput, inputs.guides.direct):
        what[left] = 0
    inputs.guides.gloss[left], inputs.guides.mean_depth[left], inputs.guides.roughness[left] = 0, 1, 1
    inputs.guides.roughness[glass] = 0.1
    stored = inputs.guides.specular.clone()
    without, mended = (image(network(source, architecture, least_specular=least), inputs) for least in (0, 0.04))
    changed = ~torch.isclose(mended, inputs.guides.emission)
    torch.testing.assert_close(without[left], inputs.guides.emission[left])
    torch.testing.assert_close(mended[:, 8:, :8], inputs.guides.emission[:, 8:, :8])
    assert changed[glass].all()
    assert torch.equal(inputs.guides.specular, stored)


@pytest.mark.parametrize("architecture", ["guided_transport", "guided_denoise"])
def test_what_reflects_more_by_a_setting_leaves_the_number_of_glossy_pixels(make_source, architecture: str) -> None:
    """A red metal that is not quite glossy: for a card glossy pixels are counted before a network sees the guides."""
    source = make_source(1)
    inputs = batch_of(source, (0,), architecture).inputs
    inputs.guides.specular[:, :8], inputs.guides.roughness[:, :8] = torch.tensor([0.58, 0.0, 0.0]), 0.1
    counted = replace(inputs, guides=replace(inputs.guides, glossy_count=inputs.guides.count_glossy()))
    assert counted.guides.reflect_at_least(0.04).count_glossy() > counted.guides.glossy_count
    made = network(source, architecture, least_specular=0.04)
    assert torch.equal(image(made, counted), image(made, inputs))


def test_a_scene_far_from_the_origin_gives_the_same_image(make_source) -> None:
    source, kind, offset = make_source(1), "guided_transport", np.float32(1024)
    chosen = NetworkSettings(width=4, architecture=kind)
    inputs, frame = batch_of(source, (0,), kind).inputs, SceneFrame.of(source.spec, *source.base(), chosen)
    inputs.guides.specular[:, :8], inputs.guides.roughness[:, :8] = 0.9, 0.3  # a metal: its lobe sums over points too
    near = image(build(chosen, frame, 0), inputs)
    away = replace(frame, centre=frame.centre + offset, base=frame.base + offset)
    inputs.points.position[:] += offset
    inputs.world_to_camera[:, :, 3] -= inputs.world_to_camera[:, :, :3].sum(-1) * offset
    torch.testing.assert_close(image(build(chosen, away, 0), inputs), near, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(("max_depth", "lit"), [(2, False), (3, True), (-1, True)])
def test_lit_points_send_nothing_by_paths_longer_than_the_images_have(make_source, max_depth: int, lit: bool) -> None:
    source, kind = make_source(1), "guided_transport"
    chosen = NetworkSettings(width=4, architecture=kind)
    frame = replace(SceneFrame.of(source.spec, *source.base(), chosen), max_depth=max_depth)
    light = build(chosen, frame, 0).lit_points(batch_of(source, (0,), kind).inputs)
    assert [bool(each.any()) for each in light[:2]] == [lit, lit]


@pytest.mark.parametrize("emission", ["linear", "log"])
@pytest.mark.parametrize("architecture", ["light_transport", "guided_transport"])
def test_normals_and_emission_of_each_configuration_are_taken_for_the_base_s(
    make_source, architecture: str, emission: str
) -> None:
    """At rest the image is that of a scene in which nothing turns; a network of one that does needs both."""
    source = make_source(2)
    geometry, cloud = source.base()
    chosen = NetworkSettings(width=4, architecture=architecture, emission=emission)
    frame = SceneFrame.of(source.spec, geometry, cloud, chosen)
    still, inputs = build(chosen, frame, 0), batch_of(source, (0, 1), architecture).inputs
    turning = build(chosen, replace(frame, changes=True), 0)
    with pytest.raises(ValueError, match="inputs"):
        image(turning, inputs)

    def given(normal: np.ndarray, light: float) -> Inputs:
        both = (torch.from_numpy(each).expand(2, -1, -1) for each in (normal, light * cloud.emission))
        return replace(inputs, points=replace(inputs.points, **dict(zip(("normal", "emission"), both, strict=True))))

    same(image(turning, given(cloud.normal, 1.0)), image(still, inputs))
    as_modelled = SceneFrame.of(source.spec, geometry, replace(cloud, normal=-cloud.normal), chosen)
    same(image(turning, given(-cloud.normal, 1.0)), image(build(chosen, as_modelled, 0), inputs))
    darker = image(turning, given(cloud.normal, 0.5)) - image(turning, given(cloud.normal, 1.0))
    assert bool(darker.abs().max() > 1e-6) == (architecture == "light_transport")


def test_inputs_that_lack_what_a_network_needs_are_named(make_source) -> None:
    source = make_source(1)
    with pytest.raises(ValueError, match="inputs"):
        image(network(source), batch_of(source, (0,), "cnn").inputs)


def test_the_seed_makes_the_weights_and_leaves_torchs_generator_alone(make_source) -> None:
    source, chosen = make_source(1), NetworkSettings(width=4)
    frame = SceneFrame.of(source.spec, *source.base(), chosen)
    before = torch.get_rng_state()
    one, same, other = (build(chosen, frame, seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["descriptor"], other["descriptor"])


# --------------------------------------------------------------------------------------------------------------- points


def test_positions_come_with_sines_and_cosines_of_each_octave(make_source) -> None:
    source = make_source(1)
    made = network(source, octaves=2)
    x = torch.tensor([[[0.5, -0.25, 1.0]]])
    wanted = torch.cat([x, *(f(k * torch.pi * x) for k in (0.5, 1.0) for f in (torch.sin, torch.cos))], dim=-1)
    torch.testing.assert_close(made.coordinates(made.centre + made.scale * x), wanted)
    torch.testing.assert_close(network(source, octaves=0).coordinates(made.centre + made.scale * x), x)


@pytest.mark.parametrize("maxima", ["absolute", "relative"])
@pytest.mark.parametrize("architecture", WITH_POINTS)
def test_the_order_of_points_and_photons_does_not_matter(make_source, architecture: str, maxima: str) -> None:
    source = make_source(3, points=300, photons=64)
    made, shuffled = (network(source, architecture, maxima=maxima) for _ in range(2))
    inputs = batch_of(source, (0, 1, 2), architecture).inputs
    order = torch.randperm(300)
    shuffled.descriptor.data.copy_(made.descriptor.data[order])
    if architecture != "feature_projection":
        shuffled.appearance.copy_(made.appearance[order])
        shuffled.base.copy_(made.base[order])
    other = replace(inputs, points=map_tensors(lambda x: x[:, order], inputs.points))
    if inputs.photons is not None:
        slots = torch.randperm(128)
        other = replace(other, photons=map_tensors(lambda x: x[:, slots], inputs.photons))
    same(image(shuffled, other), image(made, inputs))


@pytest.mark.parametrize("architecture", WITH_POINTS)
def test_points_that_are_flagged_as_absent_change_nothing_wherever_they_are(make_source, architecture: str) -> None:
    source = make_source(2, photons=64)
    made, inputs = network(source, architecture), batch_of(source, (0, 1), architecture).inputs
    inputs.points.present[:, ::3] = False
    inputs.points.seen.fill_(True)
    before = image(made, inputs)
    hidden = ~inputs.points.present[..., None]
    inputs.points.position.copy_(torch.where(hidden, 1e4, inputs.points.position))  # would win every maximum
    if inputs.photons is not None:
        empty = ~inputs.photons.present[..., None]
        for x in (inputs.photons.position, inputs.photons.direction, inputs.photons.power):
            x.copy_(torch.where(empty, 1e4, x))
    assert torch.equal(image(made, inputs), before)
    inputs.points.position.copy_(torch.from_numpy(source.base()[1].position))
    inputs.points.present.fill_(True)
    assert not torch.equal(image(made, inputs), before), "they would be seen, were they present"


@pytest.mark.parametrize("architecture", WITH_POINTS)
def test_what_is_seen_decides_what_is_projected_and_depth_does_not(make_source, architecture: str) -> None:
    source = make_source(2, photons=64)
    made, inputs = network(source, architecture), batch_of(source, (0, 1), architecture).inputs
    before = made.further(inputs)
    inputs.depth.fill_(1e-3)
    projected = [of for of in zip(made.further(inputs), before, strict=True) if of[0].shape[-1] > 3]
    assert all(torch.equal(one, other) for one, other in projected)
    for record in filter(None, (inputs.points, inputs.photons)):
        record.seen.logical_not_()
    assert not any(torch.equal(one, other) for one, other in zip(made.further(inputs), before, strict=True))


@pytest.mark.parametrize("architecture", WITH_POINTS)
def test_without_any_present_point_there_is_an_image_and_a_gradient(make_source, architecture: str) -> None:
    source = make_source(2, photons=64)
    made, inputs = network(source, architecture), batch_of(source, (0, 1), architecture).inputs
    inputs.points.present.fill_(False)
    if inputs.photons is not None:
        inputs.photons.present.fill_(False)
    made(inputs).square().sum().backward()
    assert torch.isfinite(image(made, inputs)).all()
    assert all(torch.isfinite(p.grad).all() for p in made.parameters() if p.grad is not None)


def test_a_moved_point_takes_its_descriptor_along(make_source) -> None:
    """One point alone, before one camera: its descriptor is in the pixel where it is, and nowhere else."""
    source = make_source(1)
    made, inputs = network(source, "feature_projection"), batch_of(source, (0,), "feature_projection").inputs
    inputs.points.present.fill_(False)
    inputs.points.present[0, 7] = inputs.points.seen[0, 7] = True
    for column in (3, 12):
        to_camera = inputs.world_to_camera[0].double()
        x = (column + 0.5 - 8) / made.optics.focal_px
        world = to_camera[:, :3].T @ (torch.tensor([x, 0.01, 1.0]).double() - to_camera[:, 3])
        inputs.points.position[0, 7] = world.float()
        (projected,) = made.further(inputs)
        torch.testing.assert_close(projected[0, 8, column], made.descriptor[7])
        assert torch.count_nonzero(projected.abs().sum(dim=-1)) == 1


# -------------------------------------------------------------------------------------------------------------- photons


def test_twice_as_many_photons_of_half_the_power_are_the_same_to_the_network(make_source) -> None:
    """Each one twice, as a scene with twice the paths stores it: power is over the number emitted."""
    once, twice = make_source(1, photons=64), make_source(1, photons=128)
    photons = once.read_photons(0)
    doubled = Photons(**{name: np.concatenate([x, x]) for name, x in arrays_of(photons).items()})
    doubled.power[:] *= np.float32(0.5)
    twice.read_photons = lambda _: doubled
    twice._base = once.base()  # a scene with another number of photons is another scene, whose points are others
    shown = batch_of(once, (0,), PHOTONS).inputs
    images = []
    for times, source in ((1, once), (2, twice)):
        photons = batch_of(source, (0,), PHOTONS).inputs.photons
        photons.seen.copy_(shown.photons.seen.repeat(1, times))  # in the view of `once`
        images.append(image(network(source, PHOTONS), replace(shown, photons=photons)))
    same(images[1], images[0])


def test_a_scene_without_photons_is_refused_where_they_are_needed(make_source) -> None:
    with pytest.raises(SpecError):
        network(make_source(1, photons=0), PHOTONS)
