"""Images of several views share launches: each is what it is alone."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer.bdpt.launches import images_at_once, launches

SIZE, SPP = 16, 4
SETTINGS = [{"connections": 0, "light_ratio": 0.0}, {"connections": 1, "light_ratio": 1.0}]
PATHS = SIZE * SIZE * SPP


def sensor_of(kind: str, size: int, to_world: Any = None) -> Any:
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    described = {"type": kind, "fov": 60.0, "near_clip": 0.1, "film": film}
    if kind == "thinlens":
        described |= {"aperture_radius": 0.05, "focus_distance": 3.0}
    return mi.load_dict(described if to_world is None else {**described, "to_world": to_world})


def placed(angles: list[float]) -> list[np.ndarray]:
    """Cameras around the Cornell box, at its open side."""
    return [
        np.array(mi.ScalarTransform4f().rotate([0, 1, 0], angle).look_at([0.1, 0.2, 3.4], [0, 0, 0], [0, 1, 0]).matrix)
        for angle in angles
    ]


def box() -> Any:
    described = {key: value for key, value in mi.cornell_box().items() if key not in ("sensor", "integrator")}
    return mi.load_dict(described, optimize=False)


def alone(bdpt: Any, scene: Any, kind: str, place: np.ndarray, seed: int, size: int) -> np.ndarray:
    transform = mi.ScalarTransform4f(place)
    return np.array(bdpt.render_seeds(scene, sensor_of(kind, size, transform), [seed], SPP))[0]


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("paths_at_once", [1, 2 * PATHS, 1 << 20])
def test_views_rendered_together_are_those_rendered_alone_to_the_bit(
    settings: dict[str, Any], paths_at_once: int
) -> None:
    scene, places, seeds = box(), placed([0.0, 7.0, -11.0, 0.0, 3.0]), [1, 2, 3, 4, 1]
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 5, "paths_at_once": paths_at_once, **settings})
    together = np.array(bdpt.render_seeds(scene, sensor_of("perspective", SIZE), seeds, SPP, places=np.stack(places)))
    one_by_one = [
        alone(bdpt, scene, "perspective", place, seed, SIZE) for place, seed in zip(places, seeds, strict=True)
    ]
    assert together.mean() > 0.05
    np.testing.assert_array_equal(together, one_by_one)


def wider(place: np.ndarray, fov: float) -> np.ndarray:
    """The place of a camera with another field of view than the sensor's 60°."""
    width = np.tan(np.radians(fov / 2)) / np.tan(np.radians(30))
    return place * np.array([width, width, 1, 1])


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("record", [False, True])
def test_views_of_several_fields_of_view_are_those_rendered_alone(settings: dict[str, Any], record: bool) -> None:
    """A sensor of that field of view makes it; light paths' splats and weights are among what is compared."""
    scene, fovs, seeds = box(), [25.0, 60.0, 100.0], [1, 2, 3]
    places = placed([0.0, 7.0, -11.0])
    bdpt = mi.load_dict({"type": "bdpt", "max_depth": 5, "record": record, **settings})
    wide = np.stack([wider(place, fov) for place, fov in zip(places, fovs, strict=True)])
    one_by_one = []
    for place, fov, seed in zip(places, fovs, seeds, strict=True):
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        to_world = mi.ScalarTransform4f(place)
        sensor = mi.load_dict({"type": "perspective", "fov": fov, "near_clip": 0.1, "film": film, "to_world": to_world})
        one_by_one.append(np.array(bdpt.render_seeds(scene, sensor, [seed], SPP))[0])
    together = np.array(bdpt.render_seeds(scene, sensor_of("perspective", SIZE), seeds, SPP, places=wide))
    near = np.isclose(together, np.stack(one_by_one), rtol=1e-3, atol=1e-4 * np.mean(one_by_one))
    assert near.mean() > 0.99  # a path near an edge may fall to its other side
    for image, alone_image in zip(together, one_by_one, strict=True):
        assert image.mean() == pytest.approx(alone_image.mean(), rel=2e-3)
    assert abs(together[0].mean() / together[2].mean() - 1) > 0.1


def test_views_through_a_lens_of_another_size_differ_by_rounding() -> None:
    """15 × 15 pixels are no multiple of the processor's lanes, so that sums differ by their order, too."""
    size, places, seeds = 15, placed([0.0, 7.0, -11.0]), [1, 2, 3]
    scene, bdpt = box(), mi.load_dict({"type": "bdpt", "max_depth": 5})
    together = np.array(bdpt.render_seeds(scene, sensor_of("thinlens", size), seeds, SPP, places=np.stack(places)))
    one_by_one = np.stack(
        [alone(bdpt, scene, "thinlens", place, seed, size) for place, seed in zip(places, seeds, strict=True)]
    )
    near = np.isclose(together, one_by_one, rtol=1e-3, atol=1e-4 * one_by_one.mean())
    assert near.mean() > 0.99  # a path near an edge may fall to its other side
    assert together.mean() == pytest.approx(one_by_one.mean(), rel=1e-3)


def test_a_recorded_launch_of_other_views_is_of_those_views() -> None:
    scene, sensor = box(), sensor_of("perspective", SIZE)
    recorded, direct = (mi.load_dict({"type": "bdpt", "max_depth": 4, "record": record}) for record in (True, False))
    for turn in range(4):
        places, seeds = np.stack(placed([3.0 * turn, -turn])), [turn, turn + 10]
        images = [np.array(bdpt.render_seeds(scene, sensor, seeds, SPP, places=places)) for bdpt in (recorded, direct)]
        np.testing.assert_array_equal(*images)
    dr.sync_thread()


@pytest.mark.parametrize(("pixels", "spp", "light_ratio"), [(256, 4, 1.0), (1 << 18, 8, 0.25), (1 << 19, 3, 4.0)])
def test_how_many_images_share_a_launch_changes_no_samples_of_theirs(pixels: int, spp: int, light_ratio: float) -> None:
    """The parts of an image, by which its eye paths are joined to light paths, are the same in launches of any size."""

    def parts(paths_at_once: int) -> dict[int, list[tuple[int, ...]]]:
        found: dict[int, list[tuple[int, ...]]] = {}
        for launch in launches(7, pixels, spp, light_ratio, paths_at_once):
            for image in range(launch.first_image, launch.first_image + launch.images):
                own = launch.samples, launch.first_sample, launch.light_paths, launch.first_light_path
                found.setdefault(image, []).append(own)
        return found

    assert parts(1) == parts(1 << 22) == parts(1 << 30)
    assert list(parts(1)) == list(range(7))
    assert images_at_once(pixels, spp, light_ratio, 1) == 1
    assert images_at_once(pixels, spp, light_ratio, 1 << 40) > 7
