"""Points to pixels, against a pixel-by-pixel oracle and exact ray queries."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from photonfarm.scene.view import Camera, View
from photonfarm.trainer.networks.projection import Footprint, Optics, footprint, project_mean
from photonfarm.trainer.runs.settings import Occlusion

W, H, NEAR, FAR = 12, 8, 0.1, 20.0


def optics(occlusion: str) -> Optics:
    return Optics(focal_px=7.3, width=W, height=H, near=NEAR, far=FAR, occlusion=occlusion)


def cameras(count: int, seed: int) -> torch.Tensor:
    """World-to-camera transforms at random places, (B, 3, 4)."""
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    return torch.cat([rotation, torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)], dim=2)


def keeps(p: int, u: int, v: int, sample: Sequence[np.ndarray], occlusion: str) -> bool:
    """Return whether a point of a sample is kept that lands in a pixel."""
    position, present, seen, camera, depth = sample
    if occlusion == "exact" or not present[p]:
        return bool(present[p] and seen[p])
    at, surface = camera[2, :3] @ position[p] + camera[2, 3], depth[v, u]
    if surface == 0:
        return True
    at, surface = ((FAR + NEAR - 2 * FAR * NEAR / d) / (FAR - NEAR) * 0.5 + 0.5 for d in (at, surface))  # OpenGL
    return bool(at - surface <= 1e-3)


def oracle(features: np.ndarray, sample: Sequence[np.ndarray], occlusion: str) -> np.ndarray:
    """The projection of one sample, pixel by pixel and point by point in plain Python."""
    position, camera = sample[0], sample[3]
    pixel_of = {}
    for p in range(len(position)):
        x, y, z = camera[:, :3] @ position[p] + camera[:, 3]
        if z > 0:
            pixel_of[p] = (math.floor(7.3 * x / z + W / 2), math.floor(7.3 * y / z + H / 2))
    image = np.zeros((H, W, features.shape[1]))
    for v in range(H):
        for u in range(W):
            kept = [p for p, pixel in pixel_of.items() if pixel == (u, v) and keeps(p, u, v, sample, occlusion)]
            if kept:
                image[v, u] = sum(features[p] for p in kept) / len(kept)
    return image


def random_scene(seed: int) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """Features (3, 900, 5), and the arguments of `footprint`."""
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    position, features = 4 * torch.randn(3, 900, 3, **draw), torch.randn(3, 900, 5, **draw)
    present, seen = (torch.rand(3, 900, generator=generator) < share for share in (0.8, 0.6))
    depth = 8 * torch.rand(3, H, W, **draw)
    depth[depth < 2] = 0  # nothing hit there
    return features, (position, present, seen, cameras(3, seed), depth)


@pytest.mark.parametrize("occlusion", get_args(Occlusion))
def test_a_batch_projects_as_the_oracle_does_pixel_by_pixel(occlusion: str) -> None:
    features, scene = random_scene(1)
    kept = footprint(*scene, optics(occlusion))
    found = project_mean(features, kept, H, W).numpy()
    wanted = [oracle(features[i].numpy(), [x[i].numpy() for x in scene], occlusion) for i in range(3)]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert 100 < len(kept.point) < 900
    assert (np.abs(found).sum(axis=-1) == 0).any(), "some pixels have no point, and are zero"


def test_exact_looks_at_no_depth_and_the_other_rule_at_nothing_that_is_seen() -> None:
    _, (position, present, seen, camera, depth) = random_scene(1)
    wall = torch.full_like(depth, 1e-3)
    for rule in get_args(Occlusion):
        plain = footprint(position, present, seen, camera, depth, optics(rule)).point
        walled = footprint(position, present, seen, camera, wall, optics(rule)).point
        unseen = footprint(position, present, ~seen, camera, depth, optics(rule)).point
        assert torch.equal(walled, plain) is (rule == "exact")
        assert torch.equal(unseen, plain) is (rule != "exact")
        assert not set(unseen.tolist()) & set(plain.tolist()) or rule != "exact"


def test_points_that_share_a_pixel_share_its_gradient() -> None:
    features = torch.randn(1, 5, 2, dtype=torch.float64, requires_grad=True)
    kept = Footprint(point=torch.tensor([0, 1, 3, 4]), pixel=torch.tensor([7, 7, 7, 20]))  # point 2 is dropped
    assert torch.autograd.gradcheck(lambda f: project_mean(f, kept, H, W), features)
    project_mean(features, kept, H, W).sum().backward()
    torch.testing.assert_close(features.grad[0, :, 0], torch.tensor([1 / 3, 1 / 3, 0, 1 / 3, 1]).double())


@pytest.mark.parametrize("occlusion", get_args(Occlusion))
def test_a_dropped_point_gives_and_gets_nothing_even_if_it_is_not_a_number(occlusion: str) -> None:
    features, scene = random_scene(3)
    kept = footprint(*scene, optics(occlusion))
    poisoned = features.clone()
    dropped = torch.ones(features.shape[0] * features.shape[1], dtype=torch.bool)
    dropped[kept.point] = False
    poisoned.view(-1, 5)[dropped] = torch.nan
    poisoned.requires_grad_()
    image = project_mean(poisoned, kept, H, W)
    assert torch.equal(image, project_mean(features, kept, H, W))
    image.sum().backward()
    assert torch.all(poisoned.grad.view(-1, 5)[dropped] == 0)


@pytest.mark.parametrize("occlusion", get_args(Occlusion))
def test_the_points_kept_are_those_that_an_exact_ray_query_sees(make_source, occlusion: str) -> None:
    source = make_source(40, size=128, points=4096)
    right = seen = kept = 0
    for row in range(40):
        sample = source.read(row)
        position, present = source.cloud_at(row)
        camera = Camera.of(sample.view, source.spec).world_to_camera.astype(np.float32)
        scene = position, present, sample.visibility.points, camera, sample.buffers.depth
        batch = [torch.from_numpy(x)[None] for x in scene]
        found = footprint(*batch, Optics.of(source.spec, occlusion)).point.numpy()
        batch[2].fill_(True)
        in_image = footprint(*batch, Optics.of(source.spec)).point.numpy()
        exact = np.intersect1d(in_image, np.flatnonzero(source.sees(row, position)))
        right += len(np.intersect1d(found, exact))
        seen += len(exact)
        kept += len(found)
    recall, leak = right / seen, 1 - right / kept
    assert recall >= (0.9999 if occlusion == "exact" else 0.99), f"recall {recall:.4f}, leak {leak:.4f}"
    assert leak <= (0.0001 if occlusion == "exact" else 0.01), f"recall {recall:.4f}, leak {leak:.4f}"


def test_rays_and_focal_length_are_those_of_the_camera(make_source) -> None:
    source = make_source(1, size=24)
    view = View(np.array([0.1, -0.2, 0.3], np.float32), np.array([0.7, 0.5, -0.4], np.float32))
    camera = Camera.of(view, source.spec)
    rays = Optics.of(source.spec).rays(torch.from_numpy(camera.world_to_camera).float()[None])
    np.testing.assert_allclose(rays[0].numpy(), camera.rays(), atol=1e-6)


def test_views_of_several_fields_of_view_project_as_each_alone(make_source) -> None:
    source = make_source(1, size=24)
    position, present = source.cloud_at(0)
    view, optics = source.read(0).view, Optics.of(source.spec)
    seen = replace(view, fov=np.float32(30)), replace(view, fov=np.float32(110))
    cameras = [Camera.of(each, source.spec) for each in seen]
    to_camera = torch.stack([torch.from_numpy(camera.world_to_camera).float() for camera in cameras])
    focal = torch.tensor([camera.focal_px for camera in cameras])
    rays = optics.rays(to_camera, focal)
    everything = (torch.from_numpy(position), torch.from_numpy(present), torch.ones(len(position), dtype=torch.bool))
    together = [values.expand(2, *values.shape) for values in everything]
    depth = torch.ones(2, 24, 24)
    both = footprint(*together, to_camera, depth, optics, focal)
    kept = []
    for i, camera in enumerate(cameras):
        np.testing.assert_allclose(rays[i].numpy(), camera.rays(), atol=1e-6)
        own = replace(optics, focal_px=camera.focal_px)
        alone = footprint(*(values[i : i + 1] for values in (*together, to_camera, depth)), own)
        mine = both.point // len(position) == i
        kept.append(int(mine.sum()))
        assert torch.equal(both.point[mine] - i * len(position), alone.point)
        assert torch.equal(both.pixel[mine] - i * 24 * 24, alone.pixel)
    assert 0 < kept[0] < 0.8 * kept[1]
