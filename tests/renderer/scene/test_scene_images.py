"""What a loaded scene gives: images of its seeds, buffers of its camera."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from photonfarm.core.records import arrays_of
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.groups import Fov
from photonfarm.scene.modification import rest, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import Camera, View, sample_view


def test_the_camera_of_the_sensor_is_that_of_the_spec(room: LoadedScene, somewhere: View) -> None:
    mi = backend.load(1)
    spec = room.spec
    sensor = room._sensor.aim(somewhere)
    camera = Camera.of(somewhere, spec)
    x, y = np.meshgrid((np.arange(24) + 0.5) / 24, (np.arange(16) + 0.5) / 16)
    place = mi.Point2f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)))
    ray, _ = sensor.sample_ray(0, 0, place, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.d).T.reshape(16, 24, 3), camera.rays(), atol=2e-6)
    along = camera.rays() @ camera.forward
    start = camera.origin + camera.rays() * (spec.view.near / along)[..., None]
    np.testing.assert_allclose(np.array(ray.o).T.reshape(16, 24, 3), start, atol=1e-5)
    np.testing.assert_allclose(np.array(ray.maxt).reshape(16, 24), (spec.view.far - spec.view.near) / along, rtol=1e-5)


def test_a_view_s_own_field_of_view_is_that_of_all_that_is_rendered_of_it(room: LoadedScene, somewhere: View) -> None:
    """As of a scene in which all views have it: images alone and together, buffers, guides, and the points in sight."""
    spec = room.spec

    def load(**view: object) -> LoadedScene:
        return LoadedScene(spec.model_copy(update={"view": spec.view.model_copy(update=view)}), room.scene)

    fovs = [35.0, spec.view.fov_deg, 100.0]
    views = [replace(somewhere, fov=np.float32(fov)) for fov in fovs]
    ranged = load(fov=Fov(min=20, max=120))
    position = np.random.default_rng(0).uniform([-2, 0, -2], [2, 2, 2], (200, 3)).astype(np.float32)
    lit, key, seeds = (position[:8], np.float32([[0, 1, 0]] * 8)), b"0" * 16, (5, 6, 7)
    together = ranged.render_images(views, seeds)
    inputs = ranged.inputs(views, [key] * 3, spec.guides, lit)
    seen = ranged.sees(views, position)
    for turn in (0, 2, 0):  # recorded launches, too
        one = load(fov_deg=fovs[turn])
        alone = one.render_half(somewhere, seeds[turn])
        np.testing.assert_array_equal(ranged.render_half(views[turn], seeds[turn]), alone)
        assert np.isclose(together[turn], alone, rtol=1e-3, atol=1e-4 * alone.mean()).mean() > 0.99
        (wanted,) = one.inputs([somewhere], [key], spec.guides, lit)
        for found, expected in zip(inputs[turn], wanted, strict=True):
            for name, values in arrays_of(expected).items():
                np.testing.assert_array_equal(arrays_of(found)[name], values, err_msg=name)
        np.testing.assert_array_equal(seen[turn], one.sees([somewhere], position)[0])
    assert seen[0].sum() < 0.7 * seen[2].sum()


def test_guided_light_paths_follow_from_the_configuration_alone(small: Callable[..., SceneSpec]) -> None:
    plain = small(load_spec("room"))
    spec = plain.model_copy(update={"transport": plain.transport.model_copy(update={"guided_light": True})})
    room = LoadedScene.load(spec)
    moved = sample_modification(spec, 0, 0)
    views = [sample_view(spec, moved.key(spec.radiance_id), 0, i, moved) for i in range(2)]
    room.apply(moved)
    halves = room.render_halves(views[0], (1, 2))
    room.render_halves(views[1], (3, 4))
    room.apply(rest(spec))
    at_rest = room.render_halves(views[0], (1, 2))
    room.apply(moved)
    np.testing.assert_array_equal(room.render_halves(views[0], (1, 2)), halves)
    room.forget_path_guides()
    np.testing.assert_array_equal(room.render_halves(views[0], (1, 2)), halves)
    np.testing.assert_allclose(room.render_images(views[:1] * 2, (1, 2)), halves, rtol=1e-3, atol=1e-3)
    assert np.any(halves[0] != halves[1])
    assert np.any(at_rest != halves)


def test_no_photons_are_traced_where_the_spec_wants_none(small: Callable[..., SceneSpec]) -> None:
    spec = small(load_spec("cornell"))
    spec = spec.model_copy(update={"photons": spec.photons.model_copy(update={"paths": 0})})
    assert LoadedScene.load(spec).photons(1) is None
