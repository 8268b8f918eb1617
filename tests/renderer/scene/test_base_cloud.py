from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import make_key
from photonfarm.core.records import STATIC
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.base_cloud import cloud_of, geometry_of, triangles_of
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import rebuild, sample_modification
from photonfarm.scene.spec_loading import load_spec

CHECKS = {
    "type": "checkerboard",
    "color0": {"type": "rgb", "value": [0.1, 0.1, 0.1]},
    "color1": {"type": "rgb", "value": [0.8, 0.8, 0.8]},
}
SCENE_ID = make_key("test").hex()


def scene(**shapes: dict[str, Any]) -> Any:
    return backend.load(1).load_dict({"type": "scene", **shapes}, optimize=False)


@pytest.fixture(scope="module")
def room() -> LoadedScene:
    backend.load(1)
    return LoadedScene.load(load_spec("room"))


@pytest.mark.parametrize(
    ("shape", "area"),
    [("rectangle", 4), ("cube", 24), ("sphere", 4 * np.pi), ("disk", np.pi), ("cylinder", 2 * np.pi)],
)
def test_tessellated_shapes_have_the_shape_s_area_and_face_its_way(shape: str, area: float) -> None:
    loaded = scene(shape={"type": shape})
    geometry = geometry_of(loaded.shapes(), {})
    assert geometry.areas().sum() == pytest.approx(area, rel=1e-3)
    cloud = cloud_of(loaded, geometry, 200, SCENE_ID)
    corners = geometry.vertices[geometry.faces[cloud.face]]
    winding = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.sum(winding * cloud.normal, axis=1) > 0)


@pytest.mark.parametrize("shape", ["rectangle", "cube"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_points_of_mirrored_shapes_have_the_normals_of_their_fronts(shape: str, mirrored: bool) -> None:
    mi = backend.load(1)
    to_world = mi.ScalarTransform4f().scale([-1 if mirrored else 1, 1, 1])
    loaded = scene(shape={"type": shape, "to_world": to_world, "light": {"type": "area", "radiance": 8.0}})
    cloud = cloud_of(loaded, geometry_of(loaded.shapes(), {}), 100, SCENE_ID)
    assert np.all(cloud.emission == 8)
    out = cloud.position if shape == "cube" else np.array([0, 0, 1])
    assert np.all(np.sum(cloud.normal * out, axis=1) > 0.9)


def test_a_mirrored_sphere_still_faces_outwards() -> None:
    to_world = backend.load(1).ScalarTransform4f().translate([1, 2, 3]).scale([-2, 2, 2])
    geometry = geometry_of(scene(ball={"type": "sphere", "to_world": to_world}).shapes(), {})
    a, b, c = np.moveaxis(geometry.vertices[geometry.faces].astype(np.float64), 1, 0)
    outward = np.sum(np.cross(b - a, c - a) * ((a + b + c) / 3 - (1, 2, 3)), axis=1)
    assert np.all(outward[geometry.areas() > 1e-6] > 0)


def test_shapes_that_cannot_be_triangulated_are_refused() -> None:
    distance = np.linspace(-1, 1, 4, dtype=np.float32)[:, None, None, None] * np.ones((4, 4, 4, 1), np.float32)
    grid = backend.load(1).TensorXf(distance)
    loaded = scene(field={"type": "sdfgrid", "grid": grid})
    with pytest.raises(SpecError):
        triangles_of(loaded.shapes()[0])


def test_points_know_their_colour_and_their_light() -> None:
    mi = backend.load(1)
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}}
    loaded = scene(
        floor={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": CHECKS}},
        lamp={"type": "sphere", "center": mi.ScalarPoint3f(0, 0, 3), "emitter": lamp, "bsdf": {"type": "dielectric"}},
    )
    shapes = loaded.shapes()
    geometry = geometry_of(shapes, {"lamp": 0})
    cloud = cloud_of(loaded, geometry, 600, SCENE_ID)
    shines = np.array([s.id() for s in shapes])[geometry.face_shape[cloud.face]] == "lamp"
    assert 0.6 < shines.mean() < 0.9  # by area: 4π of 4π + 4
    np.testing.assert_array_equal(cloud.group, np.where(shines, 0, STATIC))
    np.testing.assert_allclose(cloud.emission[shines], np.tile([3.0, 2.0, 1.0], (shines.sum(), 1)))
    assert not cloud.emission[~shines].any()
    assert not cloud.albedo[shines].any()
    u, v = ((cloud.position[~shines, i] + 1) / 2 for i in (0, 1))
    expected = np.where((u > 0.5) == (v > 0.5), 0.1, 0.8)
    assert np.mean(np.abs(cloud.albedo[~shines, 0] - expected) < 1e-6) == 1


def test_normals_and_albedo_of_the_room_s_cloud_are_those_of_its_surfaces(room: LoadedScene) -> None:
    geometry, cloud = room.base()
    assert len(cloud.position) == room.spec.points
    np.testing.assert_allclose(np.linalg.norm(cloud.normal, axis=1), 1, atol=1e-5)
    assert cloud.albedo.min() >= 0
    assert cloud.albedo.max() <= 1
    ids = np.array([shape.id() for shape in room.scene.shapes()])[geometry.face_shape[cloud.face]]
    ceiling = ids == "ceiling"
    np.testing.assert_allclose(cloud.normal[ceiling], np.tile([0.0, -1, 0], (ceiling.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(cloud.albedo[ceiling], np.tile([0.80, 0.79, 0.76], (ceiling.sum(), 1)), atol=1e-6)
    assert cloud.emission[np.char.startswith(ids, "ceiling-light")].min() > 0
    assert not cloud.albedo[ids == "mirror-glass"].any()


def test_the_base_is_the_scene_at_rest_whatever_configuration_it_is_in(room: LoadedScene) -> None:
    before = room.base()
    room.apply(sample_modification(room.spec, 5, 5))
    after = room.base()
    for old, new in zip(before, after, strict=True):
        for name in old.__slots__:
            np.testing.assert_array_equal(getattr(old, name), getattr(new, name), err_msg=name)


def test_the_rebuilt_cloud_lies_on_the_moved_shapes(room: LoadedScene) -> None:
    _, cloud = room.base()
    modification = sample_modification(room.spec, 5, 6)
    modification.present[:3] = (True, False, True)
    room.apply(modification)
    moved = geometry_of(room.scene.shapes(), {})
    position, present = rebuild(cloud, modification)
    a, b, c = (moved.vertices[moved.faces[cloud.face, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    with np.errstate(invalid="ignore"):
        off = np.abs(np.sum((position - a) * normal, axis=1)) / np.linalg.norm(normal, axis=1)
    mesh = np.array([shape.is_mesh() for shape in room.scene.shapes()])[moved.face_shape[cloud.face]]
    assert 0.5 < present.mean() < 1
    assert off[present & mesh].max() < 2e-6
