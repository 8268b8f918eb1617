"""The scene's own lights, dimmed or switched off by the factors of a spec."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.core.statistics import block_z_test
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.files import BUILTIN
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import View

Loader = Callable[..., LoadedScene]

FROM_ABOVE = View(np.array([0, 3.5, 3.5], np.float32), np.array([0, 0, 0], np.float32))
RGB = '<rgb name="{}" value="0.8, 0.6, 0.4"/>'


def window(inside: str, name: str = "Window", x: float = -2) -> str:
    place = f'<transform name="to_world"><rotate x="1" angle="90"/><translate x="{x}" y="2.5"/></transform>'
    return f'<shape type="rectangle" id="{name}">{place}<emitter type="area">{inside}</emitter></shape>'


def bitmap(inside: str = "") -> str:
    return f'<texture type="bitmap" name="radiance"><string name="filename" value="bright.png"/>{inside}</texture>'


VARIANT = '<string name="format" value="variant"/>'
CHECKS = f'<texture type="checkerboard" name="radiance">{RGB.format("color0")}</texture>'
SKY = '<emitter type="envmap"><string name="filename" value="sky.pfm"/><float name="scale" value="0.7"/></emitter>'
CONSTANT = f'<emitter type="constant">{RGB.format("radiance")}</emitter>'
ABOVE = '<transform name="to_world"><lookat origin="0, 3, 0" target="0, 0, 0" up="0, 0, 1"/></transform>'
KINDS = {
    "area": ("Window", window(RGB.format("radiance"))),
    "bitmap": ("Window", window(bitmap(VARIANT))),
    "checkerboard": ("Window", window(CHECKS)),
    "spectrum": ("Window", window('<spectrum name="radiance" value="400:1, 700:2"/>')),
    "envmap": ("environment", SKY),
    "constant": ("environment", CONSTANT),
    "point": (
        "Bulb",
        f'<emitter type="point" id="Bulb"><point name="position" value="0, 2, 0"/>{RGB.format("intensity")}</emitter>',
    ),
    "spot": ("Spot", f'<emitter type="spot" id="Spot">{ABOVE}{RGB.format("intensity")}</emitter>'),
    "directional": (
        "Sun",
        '<emitter type="directional" id="Sun"><vector name="direction" value="0, -1, 0"/>'
        f"{RGB.format('irradiance')}</emitter>",
    ),
    "projector": (
        "Slide",
        f'<emitter type="projector" id="Slide">{ABOVE}<texture type="bitmap" name="irradiance">'
        '<string name="filename" value="bright.png"/></texture></emitter>',
    ),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a sky and a texture in it."""
    mi = backend.load(threads=1)
    rng = np.random.default_rng(1)
    mi.Bitmap(rng.random((8, 16, 3), np.float32)).write(str(tmp_path / "sky.pfm"))
    mi.Bitmap(rng.integers(20, 255, (8, 8, 3), np.uint8)).write(str(tmp_path / "bright.png"))
    return tmp_path


def lamp(**changes: Any) -> dict[str, Any]:
    rectangle = {"size": [1.0, 1.0], "radiance": [5, 4, 3]}
    box = {"min": [-1, 2, -1], "max": [3, 2, 1]}
    return {"name": "lamp", "at": [2, 2, 0], "box": box, "rectangle": rectangle, **changes}


RAISED = '<transform name="to_world"><scale value="0.5"/><translate y="0.5"/></transform>'
BLOCK = f'<shape type="cube" id="Block">{RAISED}</shape>'


def renders(scene: LoadedScene, first: int, count: int = 12, integrator: Any = None) -> np.ndarray:
    """Images of so many seeds, (count, H, W, 3)."""
    spp = 64 if integrator else None
    return np.stack([scene.render(FROM_ABOVE, first + seed, integrator, spp) for seed in range(count)])


# --------------------------------------------------------------------------------------------------------- proportion


@pytest.mark.parametrize("kind", KINDS)
def test_half_the_factor_is_half_the_radiance(file_scene: Loader, folder: Path, kind: str) -> None:
    name, light = KINDS[kind]
    whole = file_scene(folder, BLOCK + light).render_half(FROM_ABOVE, 3)
    half = file_scene(folder, BLOCK + light, emitters={"by_id": {name: 0.5}}).render_half(FROM_ABOVE, 3)
    assert whole.mean() > 1e-4
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-6)


@pytest.mark.parametrize("kind", ["bitmap", "envmap", "point", "directional", "projector"])
def test_a_light_that_is_off_leaves_the_image_of_a_scene_without_it(
    file_scene: Loader, folder: Path, kind: str
) -> None:
    """Photons, the cloud and the buffers of the view with it; nothing is NaN."""
    name, light = KINDS[kind]
    scene = file_scene(folder, BLOCK + light, lights=[lamp()], emitters={"by_id": {name: 0}})
    bare = file_scene(folder / "bare", BLOCK, lights=[lamp()])
    test = block_z_test(renders(scene, 0), renders(bare, 100), blocks=4)
    assert test.passed, test
    photons, geometry_and_cloud = scene.photons(1), scene.base()
    assert photons is not None
    for values in (photons.power, photons.position, geometry_and_cloud[1].emission):
        assert np.isfinite(values).all()
    assert photons.power.sum() > 0


@pytest.mark.parametrize("kind", ["area", "envmap", "directional", "projector"])
def test_where_everything_is_off_all_is_black_and_finite(file_scene: Loader, folder: Path, kind: str) -> None:
    scene = file_scene(folder, BLOCK + KINDS[kind][1], emitters={"all": 0})
    assert not scene.render_halves(FROM_ABOVE, (1, 2)).any()
    photons, cloud = scene.photons(1), scene.base()[1]
    assert photons is not None
    assert not photons.power.any()
    assert (photons.bounce == -1).all()
    assert not cloud.emission.any()
    for buffer in (scene.buffers(FROM_ABOVE).depth, scene.buffers(FROM_ABOVE).albedo):
        assert np.isfinite(buffer).all()


def test_radiance_that_has_no_room_for_a_factor_is_refused_unless_it_is_switched_off(
    file_scene: Loader, folder: Path
) -> None:
    with pytest.raises(SpecError, match=r"name=.format. value=.variant."):
        file_scene(folder, window(bitmap()), emitters={"all": 0.5})
    assert not file_scene(folder, window(bitmap()), emitters={"all": 0}).render_half(FROM_ABOVE, 1).any()
    glow = '<spectrum name="radiance" type="blackbody"><float name="temperature" value="4000"/></spectrum>'
    with pytest.raises(SpecError):
        file_scene(folder, window(glow), emitters={"all": 0})
    with pytest.raises(SpecError):
        file_scene(folder, '<emitter type="sunsky"/>', emitters={"by_id": {"environment": 0.5}})


# -------------------------------------------------------------------------------------------------- what shines adds up


@pytest.mark.parametrize("own", [SKY, window(RGB.format("radiance")), SKY + window(bitmap(), "Other", -1)])
def test_lamps_alone_and_windows_alone_add_up_to_both(file_scene: Loader, folder: Path, own: str) -> None:
    content = BLOCK + own + window('<rgb name="radiance" value="5, 4, 3"/>', "Lamp", 2)
    box = {"min": [1, 2.5, -1], "max": [3, 2.5, 1]}
    moving = {"name": "lamp", "shapes": ["Lamp"], "at": [2, 2.5, 0], "box": box}
    both = renders(file_scene(folder, content), 0)
    lamps = renders(file_scene(folder, content, lights=[moving], emitters={"all": 0}), 100)
    windows = renders(file_scene(folder, content, emitters={"by_id": {"Lamp": 0}}), 200)
    assert lamps.mean() > 0.005
    assert windows.mean() > 0.005
    test = block_z_test(both, lamps + windows, blocks=4)
    assert test.passed, test


def test_a_movable_light_keeps_its_radiance_and_one_that_objects_carry_is_dimmed(
    small: Callable[..., SceneSpec],
) -> None:
    described = load_spec("room").model_dump(mode="json")
    scene = LoadedScene.load(small(parse_spec({**described, "emitters": {"all": 0.25}}, where="test")))
    geometry, cloud = scene.base()
    ids = np.array([shape.id() for shape in scene.scene.shapes()])[geometry.face_shape[cloud.face]]
    np.testing.assert_allclose(np.unique(cloud.emission[ids == "lamp-shade"], axis=0), [[2.0, 1.35, 0.7]], rtol=1e-6)
    np.testing.assert_allclose(np.unique(cloud.emission[ids == "ceiling-light-1"], axis=0), [[10.8, 9.8, 8.2]])
    removed = Modification(np.zeros((11, 3), np.float32), np.arange(11) != 5)  # the lamp leaves, and comes back
    before = scene.render_half(FROM_ABOVE, 1)
    scene.apply(removed)
    scene.apply(Modification(removed.translation, np.ones(11, np.bool_)))
    np.testing.assert_array_equal(scene.render_half(FROM_ABOVE, 1), before)


# -------------------------------------------------------------------------------------------- what others see of it


def test_a_plan_and_photons_see_only_what_shines(file_scene: Loader, folder: Path) -> None:
    from photonfarm.renderer.scene.loading import AimedSensor
    from photonfarm.renderer.strategy.content import SceneContent, light_reach

    own = SKY + window(RGB.format("radiance"))
    lit = file_scene(folder, BLOCK + own, lights=[lamp()])
    night = file_scene(folder, BLOCK + own, lights=[lamp()], emitters={"all": 0})
    found = [SceneContent.of(scene.scene, AimedSensor(scene.spec).sensor) for scene in (lit, night)]
    assert found[0].lights == {"AreaLight": 2, "EnvironmentMapEmitter": 1}
    assert found[1].lights == {"AreaLight": 1}
    assert "lights: 1 AreaLight" in found[1].sentences(4)
    reaches = [light_reach([scene.scene], scene.spec.view, 0) for scene in (lit, night)]
    assert reaches[0].hit < 0.5 < reaches[1].hit  # the sky's paths miss
    dark = file_scene(folder, BLOCK + own, emitters={"all": 0})
    content = SceneContent.of(dark.scene, AimedSensor(dark.spec).sensor)
    assert content.why_no_light_paths(4, 0.0) == "there is no light that shines"


def test_bdpt_agrees_with_path_tracing_where_lights_are_dimmed(file_scene: Loader, folder: Path) -> None:
    mi = backend.load(threads=1)
    own = SKY + window(RGB.format("radiance")) + window(CHECKS, "Other", 0)
    emitters = {"all": 0.1, "by_id": {"Other": 0.5}}
    scene = file_scene(folder, BLOCK + own, lights=[lamp()], emitters=emitters)
    path = mi.load_dict({"type": "path", "max_depth": 4})
    test = block_z_test(renders(scene, 0, 16), renders(scene, 500, 16, path), blocks=4)
    assert test.passed, test


@pytest.mark.parametrize("name", BUILTIN)
def test_the_listed_lights_of_a_built_in_room_are_those_that_shine(name: str) -> None:
    scene = LoadedScene.load(load_spec(name)).scene
    assert {shape.id() for shape in scene.shapes() if shape.is_emitter()} == BUILTIN[name].emitting
