"""A scene file, edited in place, gives what the same file written anew gives."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import Modification
from photonfarm.scene.view import View

LAMP = '<emitter type="area"><rgb name="radiance" value="6, 5, 4"/></emitter>'


def sphere(at: float, name: str = "Lamp") -> str:
    place = f'<point name="center" x="{at}" y="1" z="0"/><float name="radius" value="0.4"/>'
    return f'<shape type="sphere" id="{name}">{place}{LAMP}</shape>'


def cube(at: float) -> str:
    move = f'<transform name="to_world"><scale value="0.4"/><translate x="{at}" y="0.6" z="0.5"/></transform>'
    return f'<shape type="cube" id="Block">{move}<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'


def group(name: str, shape: str) -> dict[str, Any]:
    return {"name": name, "shapes": [shape], "at": [0, 0, 0], "box": {"min": [-9, 0, 0], "max": [9, 0, 0]}}


GROUPS = {"objects": [group("block", "Block")], "lights": [group("lamp", "Lamp")]}
FROM_ABOVE = View(np.array([0, 3.5, 3.5], np.float32), np.array([0, 0, 0], np.float32))


def placed(loaded: LoadedScene, block: float | None, lamp: float | None) -> LoadedScene:
    translation = np.array([[block or 0, 0, 0], [lamp or 0, 0, 0]], np.float32)
    loaded.apply(Modification(translation, np.array([block is not None, lamp is not None])))
    return loaded


def assert_equal_images(edited: LoadedScene, anew: LoadedScene) -> None:
    """Means of 8 independent renders, in 16 blocks per channel: |z| < 4.5 (for 48 tests, false alarm below 1e-3).

    Depth buffers agree exactly but for rounding.
    """
    runs = [
        np.stack([loaded.render_half(FROM_ABOVE, 100 * k + seed) for seed in range(8)])
        .reshape(8, 4, 4, 4, 4, 3)
        .mean(axis=(2, 4))
        for k, loaded in enumerate((edited, anew))
    ]
    difference = runs[0].mean(0) - runs[1].mean(0)
    error = np.sqrt((runs[0].var(0, ddof=1) + runs[1].var(0, ddof=1)) / 8)
    # a variance from 8 runs is itself noisy: the block's error is bounded below by half the mean error
    assert np.abs(difference / np.maximum(error, 0.5 * error.mean())).max() < 4.5
    np.testing.assert_allclose(edited.buffers(FROM_ABOVE).depth, anew.buffers(FROM_ABOVE).depth, atol=1e-4)


@pytest.mark.parametrize("sky", ["", '<emitter type="constant"><rgb name="radiance" value="0.2"/></emitter>'])
def test_an_edited_scene_renders_like_one_written_anew(
    file_scene: Callable[..., LoadedScene], sky: str, tmp_path: Path
) -> None:
    edited = placed(file_scene(tmp_path / "a", sky + cube(0) + sphere(0), **GROUPS), 1.5, -2.0)
    anew = file_scene(tmp_path / "b", sky + cube(1.5) + sphere(-2.0))
    assert_equal_images(edited, anew)


def test_what_is_removed_has_no_effect_on_light(file_scene: Callable[..., LoadedScene], tmp_path: Path) -> None:
    other = sphere(2, "Other")
    edited = placed(file_scene(tmp_path / "a", other + cube(0) + sphere(0), **GROUPS), None, None)
    assert_equal_images(edited, file_scene(tmp_path / "b", other))


CHECKS = '<texture name="radiance" type="checkerboard"><rgb name="color0" value="0.5, 0.6, 0.7"/></texture>'
PANEL = '<shape type="rectangle" id="Lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/>'
PANEL += f'</transform><emitter type="area">{CHECKS}</emitter></shape>'


@pytest.mark.parametrize("lamp", [sphere(0), PANEL], ids=["sphere", "textured panel"])
def test_a_light_that_comes_back_shines_as_before(
    file_scene: Callable[..., LoadedScene], lamp: str, tmp_path: Path
) -> None:
    edited = file_scene(tmp_path / "a", cube(0) + lamp, **GROUPS)
    before = edited.render_half(FROM_ABOVE, 3)
    assert not placed(edited, 0.0, None).render_half(FROM_ABOVE, 3).any()
    np.testing.assert_array_equal(placed(edited, 0.0, 0.0).render_half(FROM_ABOVE, 3), before)


def test_the_sky_s_bounding_sphere_follows_objects_beyond_the_old_box(
    file_scene: Callable[..., LoadedScene], tmp_path: Path
) -> None:
    """A stale sphere ends Mitsuba's shadow rays to the sky before the moved block, which then casts no shadow."""
    sky = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
    edited = file_scene(tmp_path / "a", sky + cube(0), objects=[group("block", "Block")])
    edited.apply(Modification(np.array([[40, 0, 0]], np.float32), np.array([True])))
    told = float(str(edited.scene.environment()).split("radius = [")[1].split("]")[0])
    box = edited.scene.bbox()
    assert told >= 0.5 * max(box.max[i] - box.min[i] for i in range(3))


def test_a_light_that_the_spec_adds_faces_down_and_moves(
    file_scene: Callable[..., LoadedScene], tmp_path: Path
) -> None:
    box = {"min": [-1, 2, -1], "max": [1, 2, 1]}
    rectangle = {"size": [1.0, 0.5], "radiance": [5, 5, 5]}
    added = {"name": "added", "at": [0, 2, 0], "box": box, "rectangle": rectangle}
    loaded = file_scene(tmp_path, cube(0), lights=[added], points=4096)
    geometry, cloud = loaded.base()
    shines = cloud.emission[:, 0] > 0
    assert shines.any()
    np.testing.assert_allclose(cloud.normal[shines], np.tile([0.0, -1, 0], (shines.sum(), 1)), atol=1e-6)
    light = geometry.shape_group[geometry.face_shape] == 0
    assert geometry.areas()[light].sum() == pytest.approx(0.5)
    loaded.apply(Modification(np.array([[0.5, 0, 0.25]], np.float32), np.array([True])))
    lamp = next(shape for shape in loaded.scene.shapes() if shape.id() == "added")
    assert [round(lamp.bbox().min[i], 5) for i in range(3)] == [0.0, 2.0, 0.0]
    assert [round(lamp.bbox().max[i], 5) for i in range(3)] == [1.0, 2.0, 0.5]
