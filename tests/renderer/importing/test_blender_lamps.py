"""Blender's lamps, as Cycles has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from blender_files import Loaded, needs_blender, run

from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.readers.blender import Lamps

STRAIGHT_DOWN = np.diag([1.0, 1, 1, 1]).tolist()


LAMP: dict[str, Any] = {
    "name": "Lamp",
    "kind": "POINT",
    "matrix": STRAIGHT_DOWN,
    "strength": [4.0, 2.0, 0.0],
    "normalize": True,
    "shadow_soft_size": 0.0,
    "angle": 0.0,
    "spot_size": 1.0,
    "spot_blend": 0.0,
    "shape": "SQUARE",
    "size": 2.0,
    "size_y": 1.0,
    "spread": np.pi,
}


@pytest.fixture
def emitters(tmp_path: Path) -> Callable[..., list[Any]]:
    """Function (numbers of a lamp) → Mitsuba's emitters of it."""

    kept: list[Any] = []

    def make(**numbers: Any) -> list[Any]:
        from photonfarm.renderer.scene.loading import threads_to_read_with

        scene = ImportedScene()
        lamps = Lamps(scene, tmp_path)
        lamps.put(LAMP | numbers)
        lamps.put_sky([0.0, 0.0, 0.0])
        scene.write_meshes(tmp_path)
        elements.write(scene.root, tmp_path / "lamp.xml")
        with threads_to_read_with():
            kept.append(mi.load_file(str(tmp_path / "lamp.xml"), optimize=False))
        return list(kept[-1].emitters())

    return make


def irradiance(emitters: list[Any], at: tuple[float, float, float]) -> np.ndarray:
    """What a surface at a point that faces up receives of lights without an extent."""
    reference = mi.Interaction3f()
    reference.p = mi.Point3f(*at)
    total = np.zeros(3)
    for emitter in emitters:
        sample, weight = emitter.sample_direction(reference, mi.Point2f(0.5))
        total += np.array(weight).ravel() * max(float(sample.d.y[0]), 0)
    return total


@pytest.mark.parametrize(("normalize", "intensity"), [(True, 1 / (4 * np.pi)), (False, 1 / np.pi)])
def test_a_point_has_the_intensity_of_cycles(emitters: Callable[..., Any], normalize: bool, intensity: float) -> None:
    found = irradiance(emitters(normalize=normalize), (0, -2, 0))
    assert found == pytest.approx(np.array([4, 2, 0]) * intensity / 4, rel=1e-5)


def test_a_point_with_a_radius_is_a_sphere_of_the_same_power(emitters: Callable[..., Any]) -> None:
    (light,) = emitters(shadow_soft_size=0.5)
    radiance = np.array(mi.traverse(light)["radiance.value"]).ravel()
    assert radiance * np.pi * 4 * np.pi * 0.25 == pytest.approx([4, 2, 0], rel=1e-5)


def test_a_sun_has_its_strength_on_a_surface_that_faces_it(emitters: Callable[..., Any]) -> None:
    assert irradiance(emitters(kind="SUN"), (0, -2, 0)) == pytest.approx([4, 2, 0], rel=1e-4)


def test_a_soft_sun_loses_its_soft_shadows_and_keeps_its_light(emitters: Callable[..., Any]) -> None:
    assert irradiance(emitters(kind="SUN", angle=0.5), (0, -2, 0)) == pytest.approx([4, 2, 0], rel=1e-4)


def test_the_cone_of_a_spot_is_that_of_cycles_and_is_squeezed_by_its_scale(emitters: Callable[..., Any]) -> None:
    wide = np.diag([2.0, 1, 1, 1]).tolist()
    spots = emitters(kind="SPOT", matrix=wide, spot_size=np.radians(60), spot_blend=0.5)
    on_axis = 4 / (4 * np.pi) / 4
    for x in (0.0, 0.9, 1.8):  # glTF's z is Blender's -y
        cosine = 2 / np.hypot(2, x)
        squeezed = 2 / np.hypot(2, x / 2)
        t = np.clip((squeezed - np.cos(np.pi / 6)) / (0.5 * (1 - np.cos(np.pi / 6))), 0, 1)
        wanted = on_axis * cosine**3 * t * t * (3 - 2 * t)
        assert irradiance(spots, (x, -2, 0))[0] == pytest.approx(wanted, rel=0.02, abs=1e-4)
    assert irradiance(spots, (0, -2, 1.2))[0] == 0


@pytest.mark.parametrize(("shape", "area"), [("SQUARE", 4), ("RECTANGLE", 2), ("DISK", np.pi), ("ELLIPSE", np.pi / 2)])
@pytest.mark.parametrize("normalize", [True, False])
def test_an_area_shines_down_by_its_area_in_the_world(
    emitters: Callable[..., Any], shape: str, area: float, normalize: bool
) -> None:
    scaled = np.diag([2.0, -3.0, 1, 1]).tolist()
    for matrix in (STRAIGHT_DOWN, scaled):
        (light,) = emitters(kind="AREA", shape=shape, normalize=normalize, matrix=matrix)
        axes = np.array(mi.traverse(light.get_shape())["to_world"].matrix).reshape(4, 4)[:3, :3]
        assert np.linalg.det(axes) > 0  # the corners of its triangles are those of its front
    assert float(light.get_shape().surface_area()[0]) == pytest.approx(6 * area, rel=1e-4)
    radiance = np.array(mi.traverse(light)["radiance.value"]).ravel()
    assert radiance == pytest.approx(np.array([4, 2, 0]) / np.pi / (6 * area if normalize else 1), rel=1e-4)
    normal = light.get_shape().sample_position(0.0, mi.Point2f(0.3, 0.3)).n
    assert float(normal.y[0]) == pytest.approx(-1)


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [({"strength": [0.0] * 3}, []), ({"strength": [-1.0] * 3}, ["energy"]), ({"kind": "SUN", "angle": 0.5}, ["angle"])],
)
def test_what_no_light_is_here_is_a_loss_and_dark_lamps_are_not(tmp_path: Path, numbers: Any, lost: list[str]) -> None:
    scene = ImportedScene()
    Lamps(scene, tmp_path).put(LAMP | numbers)
    assert [(change.effect, change.name, *change.places) for change in scene.changes] == [
        ("light", name, "lamp 'Lamp'") for name in lost
    ]


@pytest.fixture
def make_case(case: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """Function (folder of a case) → the folder of its files, which Blender writes."""

    def make(name: str) -> Path:
        run(case(f"{name}/make.py").read_text(), tmp_path, str(tmp_path))
        return tmp_path

    return make


def radiance_from(scene: Any, origin: list[float], target: list[float]) -> np.ndarray:
    """The mean radiance of a field of view of 10°."""
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "perspective", "fov": 10, "to_world": to_world, "film": film})
    image = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "path"}), spp=512)
    return np.array(image).mean(axis=(0, 1))


@needs_blender
@pytest.mark.slow
def test_area_lights_are_as_in_cycles(make_case: Callable[[str], Path], loaded: Loaded) -> None:
    folder = make_case("blender-area-light")
    wanted: dict[str, tuple[Any, Any]] = {
        "base": (63.7, 0.90),
        "scaled": (15.9, 0.828),
        "exposure": (254.6, 3.60),
        "unnormalized": (15.9, 0.225),
        "temperature": ((112.7, 53.7, 17.3), (1.595, 0.760, 0.245)),
        "spread": (None, 21.8),
    }
    for name, (emission, radiance) in wanted.items():
        made, scene = loaded(folder / f"{name}.blend")
        assert not [change for change in made.changes if change.effect]
        found = radiance_from(scene, [1.8, 1.6, -1.2], [1.8, 0, -1.2])
        assert found == pytest.approx(np.broadcast_to(radiance, 3), rel=0.04), name
        if emission is not None:
            hit = scene.ray_intersect(mi.Ray3f([1.8, 1.6, -1.2], [0, 1, 0]))
            assert np.array(hit.emitter(scene).eval(hit)).ravel() == pytest.approx(
                np.broadcast_to(emission, 3), rel=0.01
            )
        else:
            assert any("Lamp" in place for change in made.changes for place in change.places)


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize(("name", "colour"), [("default", (1, 1, 1)), ("kelvin", (1.771, 0.844, 0.272))])
def test_the_start_up_scene_has_its_lamp_and_its_grey_sky(
    make_case: Callable[[str], Path], loaded: Loaded, name: str, colour: tuple[float, ...]
) -> None:
    made, scene = loaded(make_case(f"blender-{name}") / f"{name}.blend")
    assert not [change for change in made.changes if change.effect]
    (lamp,) = [shape for shape in scene.shapes() if shape.is_emitter()]
    power = np.array(mi.traverse(lamp.emitter())["radiance.value"]).ravel() * np.pi * float(lamp.surface_area()[0])
    assert power == pytest.approx(1000 * np.array(colour), rel=1e-3)
    sky = mi.SurfaceInteraction3f()
    sky.wi = mi.Vector3f(0, -1, 0)
    assert np.array(scene.environment().eval(sky)).ravel() == pytest.approx([0.05088] * 3, rel=1e-3)
    assert made.camera == pytest.approx((7.359, 4.958, 6.926), abs=1e-3)
