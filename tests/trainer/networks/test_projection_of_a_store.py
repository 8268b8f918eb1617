"""The way from a spec to pixels: the built-in room rendered into a store, read, projected, against the oracle."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from projection_oracle import in_camera, sees, triangles
from read_batches import batch_of

from photonfarm.core.records import F32
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.modification import rebuild
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import Camera
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import NetworkSettings

SIZE, POINTS = 32, 1024
ROWS = (0, 3, 4)
SETTINGS = NetworkSettings(width=4, architecture="light_transport_photons")
Mask = NDArray[np.bool_]


def small_room() -> SceneSpec:
    room = load_spec("room").model_dump()
    room |= {"points": POINTS, "photons": {"paths": 128, "depth": 2}}
    room["film"] |= {"width": SIZE, "height": SIZE}
    room["transport"] |= {"half_spp": 1}
    return SceneSpec.model_validate(room)


@dataclass(frozen=True)
class Read:
    """Samples of the store as a network gets them, the network, and what the oracle sees of each sample."""

    batch: TrainingBatch
    network: Network
    cameras: list[Camera]
    points: Mask  # (B, P)
    photons: Mask  # (B, K)


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> Read:
    torch.set_num_threads(1)
    spec, root = small_room(), tmp_path_factory.mktemp("store")
    store = Store(root, create=True)
    scene = store.scene(store.plan(spec, Request(modifications=3, views_per_modification=2), shard_rows=3).scene_id)
    renderer = ShardRenderer(store, worker="test")
    for job in range(scene.jobs()):
        assert renderer.render(scene.scene_id, job)

    source, needs = SceneReader(root, scene.scene_id), ARCHITECTURES[SETTINGS.architecture].needs
    assert source.refresh().tolist() == [*range(6)]
    base = source.base()
    batch = batch_of(source, ROWS, needs)
    samples = [source.read(row) for row in ROWS]
    cameras = [Camera.of(sample.view, spec) for sample in samples]
    points, photons = [], []
    for row, sample, camera in zip(ROWS, samples, cameras, strict=True):
        corners = triangles(base[0], sample.modification)
        position, present = rebuild(base[1], sample.modification)
        stored = source.read_photons(row)
        points.append(present & sees(corners, camera, spec, position))
        photons.append((stored.bounce >= 0) & sees(corners, camera, spec, stored.position))
    network = build(SETTINGS, SceneFrame.of(spec, *base, SETTINGS), 0)
    return Read(batch, network, cameras, np.stack(points), np.stack(photons))


def test_the_store_tells_of_points_and_photons_what_the_oracle_sees(read: Read) -> None:
    inputs = read.batch.inputs
    for seen, truth in ((inputs.points.seen.numpy(), read.points), (inputs.photons.seen.numpy(), read.photons)):
        assert truth.sum() > 60
        assert (seen & truth).sum() >= 0.99 * truth.sum()
        assert (seen & ~truth).sum() <= 0.01 * seen.sum()


def test_a_pixel_of_what_is_projected_is_the_mean_over_the_points_that_the_oracle_sees_there(read: Read) -> None:
    inputs, network = read.batch.inputs, read.network
    with torch.no_grad():
        image = network.further(inputs)[0].numpy()
        features = network.point_features(inputs.points).numpy()
    wanted = [
        mean_by_pixel(camera, position, of[seen], seen)
        for camera, position, of, seen in zip(
            read.cameras, inputs.points.position.numpy(), features, read.points, strict=True
        )
    ]
    close = np.isclose(image, wanted, atol=1e-5, rtol=1e-4).all(axis=-1)
    hit = (image != 0).any(axis=-1)
    assert hit.sum() > 50
    assert (close & hit).sum() >= 0.98 * hit.sum()
    assert close.mean() >= 0.999


def mean_by_pixel(camera: Camera, position: F32, features: F32, seen: Mask) -> NDArray[np.float64]:
    """The mean of the features, (J, C), of the J points that are seen, in each pixel, point by point."""
    total, count = np.zeros((SIZE, SIZE, features.shape[1])), np.zeros((SIZE, SIZE, 1))
    for (x, y, z), feature in zip(in_camera(camera, position[seen]), features, strict=True):
        pixel = int(camera.focal_px * y / z + SIZE / 2), int(camera.focal_px * x / z + SIZE / 2)
        total[pixel] += feature
        count[pixel] += 1
    return total / np.maximum(count, 1)


def test_a_network_makes_finite_images_of_the_store_and_every_weight_gets_a_gradient(read: Read) -> None:
    image = read.network(read.batch.inputs)
    assert image.shape == (len(ROWS), SIZE, SIZE, 3)
    (image - read.batch.target.mean(dim=1)).square().mean().backward()
    for name, weight in read.network.named_parameters():
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.abs().sum() > 0 or ".hidden." in name, name
