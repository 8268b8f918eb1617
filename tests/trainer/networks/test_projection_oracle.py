"""The brute-force oracle: against a plain loop over segments and triangles, and on cases known by hand."""

import numpy as np
import pytest
from projection_oracle import first_met, in_image, sees

from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import Camera, View

NEAR, FAR = 0.5, 20.0


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    room = load_spec("room")
    view = room.view.model_copy(update={"near": NEAR, "far": FAR})
    return room.model_copy(update={"view": view, "film": room.film.model_copy(update={"width": 64, "height": 48})})


@pytest.fixture(scope="module")
def camera(spec: SceneSpec) -> Camera:
    """A camera at the origin of the world, looking along a slanted line."""
    return Camera.of(View(np.zeros(3, np.float32), np.array([0.3, -0.2, 1.0], np.float32)), spec)


def met_at(eye: np.ndarray, end: np.ndarray, corners: np.ndarray) -> float:
    """Möller and Trumbore's algorithm as published (1997), one line and one triangle; ∞ where they do not meet."""
    edge1, edge2, direction = corners[1] - corners[0], corners[2] - corners[0], end - eye
    across = np.cross(direction, edge2)
    determinant = edge1 @ across
    to_eye = eye - corners[0]
    u, v = to_eye @ across / determinant, direction @ np.cross(to_eye, edge1) / determinant
    if u < 0 or v < 0 or u + v > 1:
        return np.inf
    return float(edge2 @ np.cross(to_eye, edge1) / determinant)


def in_world(camera: Camera, *at: tuple[float, float, float]) -> np.ndarray:
    """Points in camera coordinates as the world has them."""
    axes = np.stack([camera.right, camera.down, camera.forward])
    return (np.array(at) @ axes + camera.origin).astype(np.float32)


def test_it_meets_what_a_plain_loop_meets(spec: SceneSpec, camera: Camera) -> None:
    """300 triangles all round the eye, so that some are behind it, nearer than the near plane, or off the image."""
    rng = np.random.default_rng(1)
    corners = 6 * rng.standard_normal((300, 1, 3)) + 2 * rng.standard_normal((300, 3, 3))
    position = (12 * rng.standard_normal((2000, 3))).astype(np.float32)
    position = position[in_image(camera, spec, position)]
    found = first_met(corners, camera, spec, position)
    for share, point in zip(found, position.astype(np.float64), strict=True):
        near = NEAR / ((point - camera.origin) @ camera.forward)
        shares = [met_at(camera.origin, point, each) for each in corners]
        np.testing.assert_allclose(share, min([s for s in shares if s >= near], default=np.inf), rtol=1e-9)
    assert len(position) > 50
    assert 0.3 < (found < 1).mean() < 0.98


def test_a_wall_hides_what_is_behind_it_but_not_itself_and_not_what_is_before_it(
    spec: SceneSpec, camera: Camera
) -> None:
    wall = in_world(camera, (-9, -9, 4), (9, -9, 4), (0, 9, 4))[None].astype(np.float64)
    position = in_world(camera, (0, 0, 3.9), (0.5, 0.5, 4.0), (0, 0, 4.0002), (0, 0, 4.002), (0, 0, 8))
    assert sees(wall, camera, spec, position).tolist() == [True, True, True, False, False]
    nearer = in_world(camera, (-9, -9, 0.4), (9, -9, 0.4), (0, 9, 0.4))[None].astype(np.float64)
    assert sees(nearer, camera, spec, position).all(), "what is nearer than the near plane hides nothing"
