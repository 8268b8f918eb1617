"""Points to pixels, against a pixel-by-pixel oracle and exact ray queries."""

import math

import numpy as np
import pytest
import torch

from photonfarm.shared.view import Camera, View
from photonfarm.trainer.projection import Optics, footprint, project_mean

W, H, NEAR, FAR = 12, 8, 0.1, 20.0


def optics(depth_space: str = "window", width: int = W, height: int = H) -> Optics:
    return Optics(focal_px=7.3, width=width, height=height, near=NEAR, far=FAR, depth_space=depth_space)


def cameras(count: int, seed: int) -> torch.Tensor:
    """World-to-camera transforms at random places, (B, 3, 4)."""
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    return torch.cat([rotation, torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)], dim=2)


def is_behind(z: float, surface: float, depth_space: str) -> bool:
    if surface == 0:
        return False
    if depth_space == "window":
        z, surface = ((FAR + NEAR - 2 * FAR * NEAR / d) / (FAR - NEAR) * 0.5 + 0.5 for d in (z, surface))  # OpenGL
    return z - surface > 1e-3 * (surface if depth_space == "relative" else 1)


def oracle(features, position, visible, camera, depth, depth_space):
    """The projection of one sample, point by point in plain Python."""
    total, count = np.zeros((H, W, features.shape[1])), np.zeros((H, W, 1))
    for p in range(len(position)):
        x, y, z = camera[:, :3] @ position[p] + camera[:, 3]
        if not visible[p] or z <= 0:
            continue
        u, v = math.floor(7.3 * x / z + W / 2), math.floor(7.3 * y / z + H / 2)
        if 0 <= u < W and 0 <= v < H and not is_behind(z, depth[v, u], depth_space):
            total[v, u] += features[p]
            count[v, u] += 1
    return total / np.maximum(count, 1)


def random_scene(seed: int, batch: int = 3, points: int = 900):
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    position, features = 4 * torch.randn(batch, points, 3, **draw), torch.randn(batch, points, 5, **draw)
    visible = torch.rand(batch, points, generator=generator) < 0.8
    depth = 8 * torch.rand(batch, H, W, **draw)
    depth[depth < 2] = 0  # nothing hit there
    return features, position, visible, cameras(batch, seed), depth


@pytest.mark.parametrize("depth_space", ["window", "linear", "relative"])
def test_a_batch_projects_as_the_oracle_does_point_by_point(depth_space: str) -> None:
    features, position, visible, camera, depth = random_scene(1)
    seen = footprint(position, visible, camera, depth, optics(depth_space))
    found = project_mean(features, seen, H, W).numpy()
    wanted = [
        oracle(*(x[i].numpy() for x in (features, position, visible, camera, depth)), depth_space) for i in range(3)
    ]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert 100 < len(seen.point) < 900
    assert (np.abs(found).sum(axis=-1) == 0).any(), "some pixels have no point, and are zero"


def test_a_pixel_where_nothing_was_hit_occludes_nothing() -> None:
    camera = torch.eye(3, 4, dtype=torch.float64)[None]
    position = torch.tensor([[[0.1, 0.1, 15.0]]], dtype=torch.float64)
    everywhere = torch.ones(1, 1, dtype=torch.bool)
    empty, wall = torch.zeros(1, H, W).double(), torch.full((1, H, W), 2.0).double()
    assert len(footprint(position, everywhere, camera, empty, optics()).point) == 1
    assert len(footprint(position, everywhere, camera, wall, optics()).point) == 0


def test_points_behind_the_camera_are_dropped_though_they_would_land_in_the_image() -> None:
    camera = torch.eye(3, 4)[None]
    position = torch.tensor([[[0.0, 0.0, -3.0], [0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]])
    seen = footprint(position, torch.ones(1, 3, dtype=torch.bool), camera, torch.zeros(1, H, W), optics())
    assert seen.point.tolist() == [2]


def test_gradients_flow_to_the_features() -> None:
    features, position, visible, camera, depth = random_scene(2, batch=2, points=60)
    seen = footprint(position, visible, camera, depth, optics())
    assert torch.autograd.gradcheck(lambda f: project_mean(f, seen, H, W), features.requires_grad_())


def test_a_dropped_point_gives_and_gets_nothing_even_if_it_is_not_a_number() -> None:
    features, position, visible, camera, depth = random_scene(3)
    seen = footprint(position, visible, camera, depth, optics())
    poisoned = features.clone()
    dropped = torch.ones(features.shape[0] * features.shape[1], dtype=torch.bool)
    dropped[seen.point] = False
    poisoned.view(-1, 5)[dropped] = torch.nan
    poisoned.requires_grad_()
    image = project_mean(poisoned, seen, H, W)
    assert torch.equal(image, project_mean(features, seen, H, W))
    image.sum().backward()
    assert torch.all(poisoned.grad.view(-1, 5)[dropped] == 0)


def test_the_points_kept_are_those_that_an_exact_ray_query_sees(make_source) -> None:
    source = make_source(40, size=128, points=4096)
    optics = Optics.of(source.spec)
    right = seen = kept = 0
    for row in range(40):
        sample = source.read(row)
        position, visible = source.cloud_at(row)
        camera = Camera.of(sample.view, source.spec).world_to_camera.astype(np.float32)
        cloud = [torch.from_numpy(x)[None] for x in (position, visible, camera)]
        depth = torch.from_numpy(sample.buffers.depth)[None]
        found = footprint(*cloud, depth, optics).point.numpy()
        in_image = footprint(*cloud, torch.zeros_like(depth), optics).point.numpy()
        exact = np.intersect1d(in_image, np.flatnonzero(source.sees(row, position)))
        right += len(np.intersect1d(found, exact))
        seen += len(exact)
        kept += len(found)
    recall, leak = right / seen, 1 - right / kept
    assert recall >= 0.99, f"recall {recall:.4f}, leak {leak:.4f}"
    assert leak <= 0.01, f"recall {recall:.4f}, leak {leak:.4f}"


def test_linear_depth_loses_points_of_slanted_surfaces_where_window_depth_does_not() -> None:
    """A plane at 70° to the viewing direction, its points exactly on it: all are visible. [method 2, erratum]"""
    generator = torch.Generator().manual_seed(0)
    slope = math.tan(math.radians(70))
    place = 0.5 * torch.rand(4000, 2, generator=generator, dtype=torch.float64) - 0.25
    position = torch.cat([place, 3 + slope * place[:, :1]], dim=1)[None]
    shape = Optics(focal_px=128, width=128, height=128, near=NEAR, far=FAR)
    camera = torch.eye(3, 4, dtype=torch.float64)[None]
    ray_x = ((torch.arange(128) + 0.5 - 64) / 128).double()
    depth = (3 / (1 - slope * ray_x)).expand(1, 128, 128)
    visible = torch.ones(1, 4000, dtype=torch.bool)
    kept = {}
    for space in ("window", "linear"):
        chosen = Optics(shape.focal_px, shape.width, shape.height, shape.near, shape.far, space)
        kept[space] = len(footprint(position, visible, camera, depth, chosen).point) / 4000
    assert kept["window"] >= 0.99
    assert kept["linear"] < 0.8


def test_rays_and_focal_length_are_those_of_the_camera(make_source) -> None:
    source = make_source(1, size=24)
    view = View(np.array([0.1, -0.2, 0.3], np.float32), np.array([0.7, 0.5, -0.4], np.float32))
    camera = Camera.of(view, source.spec)
    rays = Optics.of(source.spec).rays(torch.from_numpy(camera.world_to_camera).float()[None])
    np.testing.assert_allclose(rays[0].numpy(), camera.rays(), atol=1e-6)
