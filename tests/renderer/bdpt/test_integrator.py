"""The plugin as a plugin: reproducibility, edits in place, removed lights, refusals, photons."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from photonfarm.renderer import bdpt
from photonfarm.renderer.bdpt import launches, scenes
from photonfarm.renderer.bdpt.lights import emission
from tests.stability.scenes.hard_scenes import HARD_SCENES

SIZE = 16


def load(name: str = "many_lights", **more: Any) -> Any:
    return mi.load_dict({**HARD_SCENES[name](SIZE), **more}, optimize=False)


def image(scene: Any, seed: int = 0, spp: int = 4, **parameters: Any) -> Any:
    integrator = mi.load_dict({"type": "bdpt", "max_depth": 5, **parameters})
    return np.array(mi.render(scene, integrator=integrator, seed=seed, spp=spp))


def test_the_public_face_is_pinned() -> None:
    assert bdpt.__all__ == ["BidirectionalPathTracer", "TracedPhotons", "trace_photons"]


# ------------------------------------------------ Edits in place ------------------------------------------------


def compiled(function: Any) -> int:
    """Number of kernels that had to be compiled."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        function()
        return sum(1 for entry in dr.kernel_history([dr.KernelType.JIT]) if not entry["cache_hit"])


def opaque(transform: Any) -> Any:
    dr.make_opaque(transform)
    return transform


def test_edits_in_place_compile_nothing() -> None:
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([-0.3, 0.2, 0.3]).scale(0.2)}
    scene = load("many_lights", box=box)
    parameters = mi.traverse(scene)

    def place(key: str, origin: list[float], target: list[float], up: list[float], size: float = 1) -> None:
        frame = mi.Transform4f().look_at(origin=origin, target=target, up=up) @ mi.Transform4f().scale([size, size, 1])
        parameters[key] = opaque(frame)
        parameters.update()

    def everything(seed: int) -> None:
        image(scene, seed=seed)
        bdpt.trace_photons(scene, seed=seed, paths=64, depth=3)

    place("sensor.to_world", [0, -3.2, 1], [0, 0, 1], [0, 0, 1])
    place("light.to_world", [0, 0, 1.95], [0, 0, 0], [0, 1, 0], 0.3)
    everything(0)
    assert compiled(lambda: everything(1)) == 0, "another seed"

    place("sensor.to_world", [0.2, -3, 1.2], [0, 0, 0.9], [0, 0, 1])
    assert compiled(lambda: everything(2)) == 0, "the camera moved"
    vertices = dr.unravel(mi.Point3f, parameters["box.vertex_positions"])
    parameters["box.vertex_positions"] = dr.ravel(vertices + mi.Point3f(0.1, 0.1, 4))
    parameters.update()
    assert compiled(lambda: everything(3)) == 0, "an object moved, out of the old bounding box"
    place("light.to_world", [0.3, 0.2, 1.9], [0.3, 0.2, 0], [0, 1, 0], 0.3)
    assert compiled(lambda: everything(4)) == 0, "a light moved"
    for key in ("light.emitter.radiance.value", "bulb.intensity.value", "sky.radiance.value"):
        parameters[key] = mi.Color3f(0)
        parameters.update()
        assert compiled(lambda: everything(5)) == 0, f"{key} went out"


def test_dead_lights_are_never_chosen(renders: Any, assert_equal_means: Any) -> None:
    scene, without = load("many_lights"), HARD_SCENES["many_lights"](SIZE)
    parameters = mi.traverse(scene)
    dead = {"light": "light.emitter.radiance.value", "bulb": "bulb.intensity.value", "sky": "sky.radiance.value"}
    for key in dead.values():
        parameters[key] = mi.Color3f(0)
    parameters.update()
    lights = emission.read_lights(scene)
    alive = np.array(lights.selection.pmf).reshape(-1, lights.count)
    assert (np.count_nonzero(alive, axis=1) == lights.count - len(dead)).all()
    assert alive.sum(axis=1) == pytest.approx(1)

    del without["bulb"], without["sky"]
    del without["light"]["emitter"]
    without["light"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}  # a light's default
    integrator = {"type": "bdpt", "max_depth": 5}
    reference = renders(mi.load_dict(without, optimize=False), integrator, 64, range(100, 108))
    assert_equal_means(renders(scene, integrator, 64, range(8)), reference)


# ------------------------------------------------ Refusals ------------------------------------------------


def test_what_stands_just_behind_the_near_plane_hides_the_scene_from_light_paths_too() -> None:
    turned, shifted = mi.ScalarTransform4f().rotate, mi.ScalarTransform4f().translate
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": shifted([0, 0, -3]).scale(3)},
            "wall": {"type": "rectangle", "to_world": shifted([3, 0, 0]).rotate([0, 1, 0], -90).scale(3)},
            "lamp": {"type": "point", "position": [0, 0, -1], "intensity": 10.0},
            "card": {
                "type": "rectangle",
                "to_world": shifted([0, 0, -0.0101]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            },
            "sensor": {
                "type": "perspective",
                "near_clip": 0.01,
                "to_world": turned([0, 1, 0], 180),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            },
        },
        optimize=False,
    )
    assert image(scene, spp=64, connections=0, light_ratio=0.0).max() == 0
    assert image(scene, spp=64, connections=0, light_ratio=1.0).max() == 0
    assert image(scene, spp=64, connections=1, light_ratio=1.0).max() == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"connections": -1},
        {"connections": 65},
        {"connections": 1.5},
        {"light_samples": 2.7},
        {"light_samples": 65},
        {"max_depth": "8"},
        {"guided_light": "false"},
        {"light_ratio": -0.5},
        {"light_ratio": "a lot"},
        {"connections": 1, "light_ratio": 0.0},
        {"connections": 4, "light_ratio": 0.0},
        {"guided_light": True, "connections": 0, "light_ratio": 0.0},
        {"max_depth": -2},
        {"rr_depth": 0},
    ],
)
def test_parameters_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises((ValueError, RuntimeError), match=f"{next(iter(wrong))} is"):
        mi.load_dict({"type": "bdpt", **wrong})


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("scalar_rgb", ValueError, "scalar_rgb"),
        ("llvm_ad_spectral", ValueError, "llvm_ad_spectral"),
        ("llvm_ad_rgb_polarized", ValueError, "llvm_ad_rgb_polarized"),
        (None, RuntimeError, "set_variant"),
    ],
)
def test_variants_without_rgb_arrays_are_refused(
    name: str | None, error: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes.mi, "variant", lambda: name)
    with pytest.raises(error, match=said):
        scenes.require_variant()


# ------------------------------------------------ Photons ------------------------------------------------


# A point light of intensity π in a closed sphere of reflectance ½ emits 4π²; all of it arrives, and half of it after
# each bounce.
def test_photons_carry_the_power_of_the_light() -> None:
    sphere = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
    }
    light = {"type": "point", "position": [0.3, 0, 0], "intensity": {"type": "rgb", "value": np.pi}}
    scene = mi.load_dict({"type": "scene", "sphere": sphere, "light": light})
    photons = bdpt.trace_photons(scene, seed=0, paths=1000, depth=4)
    assert photons.position.shape == photons.direction.shape == photons.normal.shape == photons.power.shape == (4000, 3)
    for bounce in range(4):
        power = photons.power[photons.bounce == bounce].sum(axis=0)
        np.testing.assert_allclose(power, 4 * np.pi**2 * 0.5**bounce, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(photons.position, axis=1), 1, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(photons.direction, axis=1), 1, atol=1e-4)


def test_empty_photon_slots_are_marked() -> None:
    photons = bdpt.trace_photons(load("cove"), seed=3, paths=200, depth=6)
    empty = photons.bounce == -1
    assert empty.any()
    assert not photons.power[empty].any()
    assert (photons.power[~empty] > 0).all()
    again = bdpt.trace_photons(load("cove"), seed=3, paths=200, depth=6)
    np.testing.assert_array_equal(photons.position, again.position)


# ------------------------------------------------ Recordings ------------------------------------------------


def pair(**settings: Any) -> list[Any]:
    """Two integrators, of which the first records its launches."""
    return [mi.load_dict({"type": "bdpt", "max_depth": 5, "record": record, **settings}) for record in (True, False)]


def assert_recorded_alike(scene: Any, again: Any, plugins: list[Any], seed: int, spp: int) -> None:
    images = [
        np.array(plugin.render(each, sensor=0, seed=seed, spp=spp))
        for plugin, each in zip(plugins, (scene, again), strict=True)
    ]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize(("connections", "light_ratio"), [(0, 0.0), (1, 0.25)])
def test_recorded_launches_are_told_apart(
    connections: int, light_ratio: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By their samples, and by the clipping planes of the sensor."""
    monkeypatch.setattr(launches, "LAUNCH_PATHS", 5 * SIZE**2)  # 6 samples are a launch of 5 and one of 1
    scene, plugins = load("cove"), pair(connections=connections, light_ratio=light_ratio)
    for spp in (1, 5, 1, 6, 3, 5):
        assert_recorded_alike(scene, scene, plugins, spp, spp)
    edited = mi.traverse(scene)
    for far in (100.0, 4.0, 4.0):
        edited["sensor.far_clip"] = far
        edited.update()
        assert_recorded_alike(scene, scene, plugins, 3, 1)


@pytest.mark.parametrize("name", ["textured_light", "rotated_envmap", "bump_floor"])
def test_a_recorded_render_is_the_same_bit_by_bit(name: str) -> None:
    scene, again = load(name), load(name)  # its own for each: what one render makes ready must not help the other
    plugins = pair()
    for seed in range(3):
        assert_recorded_alike(scene, again, plugins, seed, 2)


def test_what_cannot_be_recorded_is_rendered_all_the_same() -> None:
    described = HARD_SCENES["cove"](SIZE)
    described["sensor"] = {**described["sensor"], "type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
    scene, plugins = mi.load_dict(described, optimize=False), pair()
    for seed in range(3):
        assert_recorded_alike(scene, scene, plugins, seed, 2)
