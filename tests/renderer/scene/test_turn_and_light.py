"""Groups that turn, and lights that change what they emit: each as in a scene that was modelled so."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.core.statistics import block_z_test
from photonfarm.renderer.jobs.render import lit_points
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.base_cloud import cloud_of, geometry_of
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.check.shapes import placements
from photonfarm.renderer.tools.plan_view import PlanView
from photonfarm.scene.modification import Modification, rebuild, rebuild_surfaces, rest, sample_modification
from photonfarm.scene.view import View, sample_view

Loader = Callable[..., LoadedScene]

FROM_ABOVE = View(np.array([0, 3.5, 3.5], np.float32), np.array([0, 0, 0], np.float32))
AT, STEP, ANGLE = (0.5, 0.0, 0.25), (-0.75, 0.125, 0.5), 40.0
EVERYWHERE = {"min": [-3, 0, -3], "max": [3, 1, 3]}
LAMP = '<emitter type="area"><rgb name="radiance" value="6, 5, 4"/></emitter>'
RGB = '<rgb name="{}" value="0.8, 0.6, 0.4"/>'


def shapes(turn: float | None = None) -> str:
    """A mesh with normals, round shapes, and a tilted lamp that is lit on one side; or all of them turned and moved."""
    after = ""
    if turn is not None:
        move = " ".join(f'{axis}="{-value}"' for axis, value in zip("xyz", AT, strict=True))
        back = " ".join(f'{axis}="{at + by}"' for axis, at, by in zip("xyz", AT, STEP, strict=True))
        after = f'<translate {move}/><rotate y="1" angle="{turn}"/><translate {back}/>'
    described = {
        "cube": ("Block", '<scale x="0.7" y="0.3" z="0.2"/><translate x="0.5" y="0.3"/>', ""),
        "sphere": ("Ball", '<scale value="0.3"/><translate x="1.4" y="0.4" z="0.4"/>', ""),
        "cylinder": ("Rod", '<scale x="0.1" y="0.1" z="0.8"/><translate x="-0.4" y="0.8" z="0.3"/>', ""),
        "rectangle": ("Lamp", '<scale value="0.3"/><rotate y="1" angle="70"/><translate y="1" z="0.9"/>', LAMP),
    }
    return "".join(
        f'<shape type="{kind}" id="{name}"><transform name="to_world">{place}{after}</transform>{inside}</shape>'
        for kind, (name, place, inside) in described.items()
    )


def group(**changes: Any) -> dict[str, Any]:
    """All of them as one light that turns."""
    turn = {"min": -180, "max": 180}
    named = {"name": "things", "shapes": ["Block", "Ball", "Rod", "Lamp"]}
    return {**named, "at": AT, "box": EVERYWHERE, "turn": turn, "removal_probability": 0.25, **changes}


def changed(scene: LoadedScene, **columns: float) -> Modification:
    """The scene's only group with these values of the vector, and otherwise at rest."""
    vector = rest(scene.spec).vector
    for name, value in columns.items():
        vector[0, ("x", "y", "z", "present", "turn", "power", "red", "green", "blue").index(name)] = value
    return Modification.from_vector(vector)


def renders(scene: LoadedScene, first: int, count: int = 8) -> np.ndarray:
    return np.stack([scene.render_half(FROM_ABOVE, first + seed) for seed in range(count)])


def test_a_turned_group_is_one_that_was_modelled_so(file_scene: Loader, tmp_path: Path) -> None:
    """Its image, its buffers, its points with their normals, and its photons."""
    scene = file_scene(tmp_path, shapes(), lights=[group()])
    modelled = file_scene(tmp_path / "modelled", shapes(ANGLE), lights=[group(turn=None)])
    modification = changed(scene, x=STEP[0], y=STEP[1], z=STEP[2], turn=ANGLE)
    base = scene.base()[1]
    straight = renders(scene, 0)
    scene.apply(modification)
    turned, true = renders(scene, 0), renders(modelled, 100)
    assert block_z_test(turned, true, blocks=4).passed
    assert not block_z_test(straight, true, blocks=4).passed
    buffers, expected = scene.buffers(FROM_ABOVE), modelled.buffers(FROM_ABOVE)
    for name in ("depth", "normal"):
        differ = np.abs(getattr(buffers, name) - getattr(expected, name)) > 1e-4
        assert differ.mean() < 0.01, name  # at edges a ray may meet either surface

    geometry = geometry_of(modelled.scene.shapes(), dict.fromkeys(group()["shapes"], 0))
    cloud = cloud_of(modelled.scene, geometry, scene.spec.points, scene.spec.radiance_id)
    (position, present), (normal, emission) = rebuild(base, modification), rebuild_surfaces(base, modification)
    assert present.all()
    np.testing.assert_array_equal(base.group, cloud.group)
    for one, other in ((position, cloud.position), (normal, cloud.normal), (emission, cloud.emission)):
        np.testing.assert_allclose(one, other, atol=2e-5)
    np.testing.assert_array_equal(lit_points(base, modification)[1], normal)
    photons, others = scene.photons(3), modelled.photons(3)
    assert photons is not None
    assert others is not None
    np.testing.assert_allclose(photons.power.sum(axis=0), others.power.sum(axis=0), rtol=1e-3)
    first = np.abs(photons.position - others.position).max(axis=1) < 1e-3
    assert first.mean() > 0.98


def test_nothing_is_compiled_for_a_turn_or_another_light_and_at_rest_all_is_as_before(
    file_scene: Loader, tmp_path: Path
) -> None:
    import drjit as dr

    lamp = group(power={"min": 0.1, "max": 2}, colour=[[1, 1, 1], [1, 0.5, 0.25]])
    sky = {"name": "sky", "shapes": ["environment"], "power": {"min": 0, "max": 1}, "removal_probability": 0.5}
    content = shapes() + f'<emitter type="constant">{RGB.format("radiance")}</emitter>'
    scene = file_scene(tmp_path, content, lights=[lamp, sky])
    before = scene.render_half(FROM_ABOVE, 1)
    seen: set[str] = set()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        for i in range(8):
            modification = sample_modification(scene.spec, 3, i)
            scene.apply(modification)
            view = sample_view(scene.spec, modification.key(scene.spec.radiance_id), 3, i)
            scene.buffers(view)
            scene.render_half(view, i)
            scene.photons(i)
            used = {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}
            assert i < 3 or used <= seen, f"modification {i} used new kernels"
            seen |= used
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    fresh = LoadedScene.load(scene.spec, tmp_path)
    fresh.apply(modification)
    np.testing.assert_array_equal(scene.render_half(view, 9), fresh.render_half(view, 9))
    scene.apply(rest(scene.spec))
    np.testing.assert_array_equal(scene.render_half(FROM_ABOVE, 1), before)


KINDS = {
    "area": ("Lamp", f'<shape type="disk" id="Lamp"><emitter type="area">{RGB.format("radiance")}</emitter></shape>'),
    "bitmap": (
        "Lamp",
        '<shape type="rectangle" id="Lamp"><emitter type="area"><texture type="bitmap" name="radiance">'
        '<string name="filename" value="sky.pfm"/></texture></emitter></shape>',
    ),
    "envmap": ("environment", '<emitter type="envmap"><string name="filename" value="sky.pfm"/></emitter>'),
    "constant": ("environment", f'<emitter type="constant">{RGB.format("radiance")}</emitter>'),
    "directional": (
        "Sun",
        '<emitter type="directional" id="Sun"><vector name="direction" value="0, -1, 0"/>'
        f"{RGB.format('irradiance')}</emitter>",
    ),
}
RAISED = '<transform name="to_world"><scale value="0.5"/><translate y="0.5" x="1.5"/></transform>'
BLOCK = f'<shape type="cube" id="Block">{RAISED}</shape>'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a sky in it."""
    sky = np.random.default_rng(1).random((8, 16, 3), np.float32)
    backend.load(threads=1).Bitmap(sky).write(str(tmp_path / "sky.pfm"))
    return tmp_path


@pytest.mark.parametrize("kind", KINDS)
def test_light_is_in_proportion_to_power_and_colour(file_scene: Loader, folder: Path, kind: str) -> None:
    """Bit by bit where the factor is a power of two; without a group that shines the image is black."""
    name, light = KINDS[kind]
    described = {"power": {"min": 0, "max": 4}, "colour": [[1, 1, 1], [1, 0.5, 0]], "removal_probability": 0.5}
    scene = file_scene(folder, BLOCK + light, lights=[{"name": "light", "shapes": [name], **described}])
    whole, base = scene.render_half(FROM_ABOVE, 3), scene.base()[1]
    assert whole.mean() > 1e-4
    scene.apply(changed(scene, power=0.5))
    np.testing.assert_array_equal(scene.render_half(FROM_ABOVE, 3), 0.5 * whole)
    scene.apply(warm := changed(scene, power=2, green=0.5, blue=0))
    image, expected = scene.render_half(FROM_ABOVE, 3), whole * np.float32([2, 1, 0])
    if kind in ("bitmap", "envmap"):  # whose texels are chosen by their brightness
        image, expected = image.mean(axis=(0, 1)), expected.mean(axis=(0, 1))
    np.testing.assert_allclose(image, expected, 0.02 if image.ndim == 1 else 1e-4)
    emission = rebuild_surfaces(base, warm)[1]
    np.testing.assert_allclose(emission, base.emission * np.float32([2, 1, 0]), rtol=1e-6)
    assert emission.any() == (name == "Lamp")
    for dark in (changed(scene, power=0), changed(scene, present=0)):
        scene.apply(dark)
        assert not scene.render_half(FROM_ABOVE, 3).any()
    scene.apply(rest(scene.spec))
    np.testing.assert_array_equal(scene.render_half(FROM_ABOVE, 3), whole)


def test_a_light_that_cannot_change_so_is_refused(file_scene: Loader, folder: Path) -> None:
    sky = {"name": "sky", "shapes": ["environment"], "power": {"min": 0, "max": 1}}
    with pytest.raises(SpecError, match="Sunsky"):
        file_scene(folder, '<emitter type="sunsky"/>', lights=[sky])
    with pytest.raises(SpecError, match="no shape to move"):
        file_scene(folder, KINDS["envmap"][1], lights=[{**sky, "at": [1, 0, 0], "box": EVERYWHERE}])
    with pytest.raises(SpecError, match="lacks at"):
        file_scene(folder, KINDS["area"][1], lights=[{"name": "lamp", "shapes": ["Lamp"]}])


@pytest.mark.parametrize(
    ("kind", "changes", "columns"),
    [
        ("envmap", {"power": {"min": 0, "max": 4}}, {"red": 0.5}),
        ("bitmap", {"at": (0, 0, 0), "box": EVERYWHERE, "turn": {"min": 0, "max": 9}}, {"power": 2.0}),
    ],
)
def test_a_change_by_hand_that_a_light_cannot_have_is_refused_before_anything_is_edited(
    file_scene: Loader, folder: Path, kind: str, changes: dict[str, Any], columns: dict[str, float]
) -> None:
    name, light = KINDS[kind]
    if kind == "bitmap":
        backend.load(threads=1).Bitmap(np.full((4, 4, 3), 99, np.uint8)).write(str(folder / "slide.png"))
        light = light.replace("sky.pfm", "slide.png")
    block = {"name": "block", "shapes": ["Block"], "at": (0, 0, 0), "box": EVERYWHERE}
    scene = file_scene(folder, BLOCK + light, objects=[block], lights=[{"name": "light", "shapes": [name], **changes}])
    before = scene.render_half(FROM_ABOVE, 3)
    vector = rest(scene.spec).vector
    vector[0, 0], vector[1] = 0.5, changed(scene, **columns).vector[0]
    with pytest.raises(SpecError, match=r"light 'light' (.* list its colours in the spec|has radiance.data in 8 bits)"):
        scene.apply(Modification.from_vector(vector))
    scene.apply(rest(scene.spec))
    np.testing.assert_array_equal(scene.render_half(FROM_ABOVE, 3), before)


def test_a_check_tries_angles_and_the_plan_shows_them(file_scene: Loader, tmp_path: Path) -> None:
    """A beam that stays clear of a wall until it turns."""
    block = '<shape type="cube" id="{}"><transform name="to_world"><scale {}/><translate {}/></transform></shape>'
    wall = block.format("Wall", 'x="3" y="2" z="0.1"', 'z="-1" y="2"')
    beam = block.format("Beam", 'x="0.8" y="0.3" z="0.1"', 'z="-0.5" y="0.5"')
    there = {"name": "beam", "shapes": ["Beam"], "at": [0, 0, -0.5]}
    there["box"] = {"min": [-0.5, 0, -0.5], "max": [0.5, 0, -0.5]}
    content = wall + beam + KINDS["constant"][1]
    shares = []
    for turn in ({}, {"turn": {"min": -90, "max": 90}}):
        scene = file_scene(tmp_path, content, objects=[{**there, **turn}])
        geometry = scene.base()[0]
        shares.append(placements(scene, geometry)[0].cut)
    assert shares[0] == 0 < 0.3 < shares[1]
    plan = PlanView.of(scene.spec, geometry)
    standing, turned = (str(plan.configuration(changed(scene, turn=degrees), [])) for degrees in (0, 90))
    assert "polygon" not in standing
    polygon = re.search('<polygon class="thing hue0" points="([^"]*)"', turned)
    assert polygon is not None
    corners = np.array([[float(number) for number in point.split(",")] for point in polygon[1].split()])
    width, height = np.ptp(corners, axis=0)
    assert height == pytest.approx(8 * width, rel=0.01)
