"""View sampling, supplement 2.2. Significance of the statistical tests: 1e-4 each, seeds fixed."""

import numpy as np
import pytest
from scipy import stats

from photonfarm.core.keys import make_key
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.scene.view import Camera, View, sample_view, sample_views

COUNT = 4000


@pytest.fixture
def sampled(static_spec: SceneSpec) -> np.ndarray:
    return np.array([sample_view(static_spec, make_key("m", i % 7), 0, i).vector for i in range(COUNT)])


def test_origins_and_look_at_points_are_uniform_in_their_boxes(static_spec: SceneSpec, sampled: np.ndarray) -> None:
    boxes = [static_spec.view.origin] * 3 + [static_spec.view.look_at] * 3
    for column, box in enumerate(boxes):
        low, high = box.low[column % 3], box.high[column % 3]
        assert stats.kstest(sampled[:, column], "uniform", (low, high - low)).pvalue > 1e-4


def test_axes_are_uncorrelated_and_so_are_origin_and_look_at_point(sampled: np.ndarray) -> None:
    correlation = np.corrcoef(sampled.T) - np.eye(6)
    assert np.abs(correlation).max() * np.sqrt(COUNT) < 4.5


def test_a_view_depends_on_configuration_seed_and_index(static_spec: SceneSpec) -> None:
    views = {
        sample_view(static_spec, make_key(m), seed, i).vector.tobytes()
        for m in ("a", "b")
        for seed in (0, 1)
        for i in (0, 1)
    }
    assert len(views) == 8


def test_a_look_at_point_on_the_origin_is_drawn_again() -> None:
    # both boxes are one tiny cube beside a far corner: without drawing again, some pairs would nearly coincide
    near = {"min": [0, 0, 0], "max": [1e-3, 1e-3, 1e-3]}
    wide = {"min": [0, 0, 0], "max": [1e-3, 1e-3, 5.0]}
    spec = parse_spec(
        {"name": "t", "scene": {"builtin": "cornell"}, "view": {"origin": near, "look_at": wide}}, where="test"
    )
    count = 20_000
    views = sample_views(spec, [make_key("m")] * count, 0, range(count), np.ones((count, 0, 4), np.float32))
    distance = np.linalg.norm(views[:, 3:] - views[:, :3], axis=1)
    assert distance.min() >= 0.999e-4 * 5
    assert (distance < 2e-3).any()


def test_rays_are_unit_vectors_through_the_pixel_centres(static_spec: SceneSpec) -> None:
    view = View(np.array([1, 2, 3], np.float32), np.array([0, 1.5, -1], np.float32))
    camera = Camera.of(view, static_spec)
    rays = camera.rays()
    assert np.allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    local = rays @ np.stack([camera.right, camera.down, camera.forward], axis=1)
    v, u = np.mgrid[: camera.height, : camera.width]
    assert np.allclose(local[..., 0] / local[..., 2] * camera.focal_px + camera.width / 2, u + 0.5, atol=1e-3)
    assert np.allclose(local[..., 1] / local[..., 2] * camera.focal_px + camera.height / 2, v + 0.5, atol=1e-3)


def test_the_picture_is_upright_and_not_mirrored(static_spec: SceneSpec) -> None:
    # looking along −z with +y up, +x is to the right
    camera = Camera.of(View(np.zeros(3, np.float32), np.array([0, 0, -1], np.float32)), static_spec)
    assert np.allclose(camera.right, [1, 0, 0])
    assert np.allclose(camera.down, [0, -1, 0])


def test_world_to_camera_puts_the_look_at_point_on_the_axis(static_spec: SceneSpec) -> None:
    view = View(np.array([1, 2, 3], np.float32), np.array([0, 1.5, -1], np.float32))
    camera = Camera.of(view, static_spec)
    point = camera.world_to_camera @ np.append(view.target, 1)
    assert np.allclose(point[:2], 0, atol=1e-6)
    assert point[2] == pytest.approx(np.linalg.norm(view.target - view.origin))


def test_a_view_straight_up_still_has_a_camera(static_spec: SceneSpec) -> None:
    camera = Camera.of(View(np.zeros(3, np.float32), np.array([0, 1, 0], np.float32)), static_spec)
    axes = np.stack([camera.right, camera.down, camera.forward])
    assert np.allclose(axes @ axes.T, np.eye(3))
