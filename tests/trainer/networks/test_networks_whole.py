"""The network of every architecture: what it sees and what it does not, order, weights."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import read_batches
import torch

from photonfarm.core.errors import SpecError
from photonfarm.core.records import Photons, arrays_of
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import Feed
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
def test_channels_stay_last_in_memory_through_every_convolution(make_source, architecture: str) -> None:
    source, seen = make_source(2, photons=64), []
    made = network(source, architecture)
    for layer in made.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.register_forward_hook(lambda _, given, out: seen.extend([*given, out]))
    image(made, batch_of(source, (0, 1), architecture).inputs)
    assert len(seen) == 2 * 22
    assert all(tensor.is_contiguous(memory_format=torch.channels_last) for tensor in seen)


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


def test_the_logarithm_of_emission_lets_a_lamp_stand_out_beside_a_window(make_source) -> None:
    source = make_source(1)
    geometry, cloud = source.base()
    emission = np.zeros_like(cloud.emission)
    emission[0], emission[1] = 100.0, 1.0  # window, lamp
    cloud = replace(cloud, emission=emission)

    def lamp_over_window(kind: str) -> float:
        chosen = NetworkSettings(width=4, emission=kind)
        shown = SceneFrame.of(source.spec, geometry, cloud, chosen).appearance[:, 6:]
        assert np.sqrt(np.mean(shown**2)) == pytest.approx(1)
        return float(shown[1, 0] / shown[0, 0])

    assert lamp_over_window("linear") == pytest.approx(0.01)
    assert lamp_over_window("log") > 0.02


def test_relative_maxima_are_zero_in_the_base_configuration_and_not_elsewhere(make_source) -> None:
    source = make_source(2)
    made, points = network(source, maxima="relative"), batch_of(source, (0, 1)).inputs.points
    with torch.no_grad():
        moved = made.point_features(points)[..., 32:]
        points.position.copy_(made.base)
        points.present.fill_(True)
        unmoved = made.point_features(points)[..., 32:]
    assert moved.abs().amax(dim=(1, 2)).min() > 1e-3
    assert unmoved.abs().max() < 1e-6


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
def test_a_point_that_is_not_seen_is_in_no_pixel_of_what_is_projected(make_source, architecture: str) -> None:
    """Other points may know of it, by the maximum over all; so its feature alone is spoilt, before the projection."""
    source = make_source(2, photons=64)
    made, inputs = network(source, architecture), batch_of(source, (0, 1), architecture).inputs
    plain, project = made.further(inputs), made.project
    hidden = [inputs.points.present & ~inputs.points.seen]
    if inputs.photons is not None:
        hidden.append(inputs.photons.present & ~inputs.photons.seen)
    assert all(flags.sum() > 10 for flags in hidden)

    def poisoned(features: torch.Tensor, position: torch.Tensor, *flags: Any) -> torch.Tensor:
        (which,) = (those for those in hidden if those.shape == features.shape[:2])
        return project(torch.where(which[..., None], torch.nan, features), position, *flags)

    made.project = poisoned
    assert all(torch.equal(one, other) for one, other in zip(made.further(inputs), plain, strict=True))


def test_a_descriptor_of_a_point_that_is_not_seen_changes_nothing_without_light_transport(make_source) -> None:
    source = make_source(2)
    made, inputs = network(source, "feature_projection"), batch_of(source, (0, 1), "feature_projection").inputs
    before = image(made, inputs)
    unseen = ~inputs.points.seen.any(dim=0)
    made.descriptor.data[unseen] = torch.nan
    assert torch.equal(image(made, inputs), before)
    made(inputs).square().sum().backward()
    assert torch.all(made.descriptor.grad[unseen] == 0)
    assert (made.descriptor.grad[~unseen] != 0).any(dim=1).all()


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


def test_points_beyond_those_used_are_left_out(make_source) -> None:
    source = make_source(1, points=256)
    assert network(source, points=100).descriptor.shape == (100, 32)


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


def test_photons_reach_the_image_and_so_the_light_that_sent_them(make_source) -> None:
    source = make_source(2, photons=64)
    made, inputs = network(source, PHOTONS), batch_of(source, (0, 1), PHOTONS).inputs
    before = image(made, inputs)
    for name in ("position", "power"):
        values = getattr(inputs.photons, name)
        kept = values.clone()
        values.mul_(0.5).add_(0.1)
        assert not torch.equal(image(made, inputs), before), name
        values.copy_(kept)
    inputs.photons.present.fill_(False)
    assert not torch.equal(image(made, inputs), before)


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


def test_photons_are_fed_as_the_store_has_them(make_source, commit, tiny, tmp_path: Path) -> None:
    analytic = make_source(1, photons=32)
    scene = Store(tmp_path / "store", create=True).add(analytic.spec)
    scene.write_base(*analytic.base())
    scene.plan(Request(modifications=2, views_per_modification=2), shard_rows=2)
    for job in range(scene.jobs()):
        commit(scene, job)
    source = SceneReader(scene.storage.root, scene.scene_id)
    with Feed(source, tiny(network=NetworkSettings(width=4, architecture=PHOTONS))) as feed:
        feed.ask([3, 0])
        batch = feed.take()
        for place, row in enumerate((3, 0)):
            for name, wanted in arrays_of(source.read_photons(row)).items():
                np.testing.assert_array_equal(getattr(batch.inputs.photons, name)[place].numpy(), wanted)
            seen = source.read(row).visibility.photons
            np.testing.assert_array_equal(batch.inputs.photons.seen[place].numpy(), seen)
            assert 0 < seen.sum() < 32
        assert batch.inputs.photons.present.sum(dim=1).tolist() == [32, 32]  # the second hits of each are empty
        assert not torch.equal(batch.inputs.photons.position[0], batch.inputs.photons.position[1])


def test_a_scene_without_photons_is_refused_where_they_are_needed(make_source) -> None:
    with pytest.raises(SpecError):
        network(make_source(1, photons=0), PHOTONS)
