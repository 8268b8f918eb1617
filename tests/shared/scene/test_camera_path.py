"""Camera paths: through the views that are given, without a jump, and refused where they make no sense."""

import json
from pathlib import Path

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.scene.camera_path import ORBIT, CameraPath, orbit
from photonfarm.scene.spec_loading import load_spec

KEYS = np.array([[0, 0, 0, 5, 1, 0], [1, 0, 2, 5, 1, 1], [3, 1, 2, 5, 2, 2], [4, 1, 0, 5, 1, 0]], np.float32)


def path(keys: np.ndarray, frames: int, *, closed: bool = False) -> np.ndarray:
    views = [{"origin": list(map(float, key[:3])), "look_at": list(map(float, key[3:]))} for key in keys]
    described = {"frames": frames, "views": views, "closed": closed}
    return np.array([view.vector for view in CameraPath.model_validate(described).sample()])


def test_the_path_passes_through_every_view_and_begins_and_ends_with_one() -> None:
    np.testing.assert_allclose(path(KEYS, 10)[::3], KEYS, atol=1e-6)


def test_a_closed_path_passes_through_every_view_and_does_not_repeat_the_first() -> None:
    np.testing.assert_allclose(path(KEYS, 12, closed=True)[::3], KEYS, atol=1e-6)


@pytest.mark.parametrize("closed", [True, False])
def test_the_path_has_neither_jumps_nor_kinks(closed: bool) -> None:
    """Steps and changes of steps become small as frames become many: of a curve with a kink the latter would not."""
    views = path(KEYS, 3000, closed=closed)
    steps = np.diff(np.concatenate([views, views[:1]]) if closed else views, axis=0)
    assert np.abs(steps).max() < 0.01
    assert np.abs(np.diff(steps, axis=0)).max() < 1e-4


def test_two_views_are_joined_by_a_straight_line_and_one_view_stands_still() -> None:
    line = path(KEYS[:2], 9)
    direction = KEYS[1] - KEYS[0]
    along = (line - KEYS[0]) @ direction / (direction @ direction)
    np.testing.assert_allclose(line, KEYS[0] + along[:, None] * direction, atol=1e-6)
    assert (np.diff(along) > 0).all()
    for closed in (True, False):
        np.testing.assert_array_equal(path(KEYS[:1], 3, closed=closed), np.repeat(KEYS[:1], 3, axis=0))
    np.testing.assert_array_equal(path(KEYS, 1), KEYS[:1])


def test_an_orbit_goes_once_around_inside_the_box_of_origins_and_looks_at_the_middle() -> None:
    spec = load_spec("room")
    views = orbit(spec, 40)
    origins = np.array([view.origin for view in views])
    low, high = np.array(spec.view.origin.low), np.array(spec.view.origin.high)
    offset = (origins - 0.5 * (low + high)) / (0.5 * (high - low))
    np.testing.assert_allclose(np.linalg.norm(offset[:, [0, 2]], axis=1), ORBIT, atol=1e-5)
    np.testing.assert_allclose(offset[:, 1], 0, atol=1e-6)
    turned = np.unwrap(np.arctan2(offset[:, 2], offset[:, 0]))
    np.testing.assert_allclose(np.diff(turned), 2 * np.pi / 40, atol=1e-5)
    middle = 0.5 * (np.array(spec.view.look_at.low) + np.array(spec.view.look_at.high))
    assert all(np.allclose(view.target, middle) for view in views)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("no json", r"path\.json"),
        (json.dumps({"frames": 3}), "views"),
        (json.dumps({"frames": 0, "views": [{"origin": [0, 0, 0], "look_at": [1, 0, 0]}]}), "frames"),
        (json.dumps({"frames": 3, "views": [{"origin": [0, 0], "look_at": [1, 0, 0]}]}), "origin"),
        (json.dumps({"frames": 3, "fps": 12, "views": [{"origin": [0, 0, 0], "look_at": [1, 0, 0]}]}), "fps"),
        ('{"frames": 3, "views": [{"origin": [0, 0, NaN], "look_at": [1, 0, 0]}]}', r"origin\.2"),
    ],
)
def test_a_file_that_is_no_camera_path_is_refused_with_what_is_wrong(tmp_path: Path, content: str, named: str) -> None:
    file = tmp_path / "path.json"
    file.write_text(content)
    with pytest.raises(SpecError, match=named):
        CameraPath.load(file)
    with pytest.raises(SpecError):
        CameraPath.load(tmp_path / "missing.json")


def test_a_camera_that_stands_where_it_looks_at_is_refused() -> None:
    with pytest.raises(SpecError):
        path(np.ones((1, 6), np.float32), 2)
