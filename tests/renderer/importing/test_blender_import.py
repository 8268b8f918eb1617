"""What comes of Blender's files: lamps as Cycles has them, all that is drawn, materials, USD and FBX."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import Loaded, from_sky

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.readers import blender

Run = Callable[..., None]

STRAIGHT_DOWN = np.diag([1.0, 1, 1, 1]).tolist()
SPOT = {"shadow_soft_size": 0.0, "spot_size": 1.0, "spot_blend": 0.0}
AREA = {"shape": "SQUARE", "size": 2.0, "size_y": 1.0, "spread": np.pi}
LAMP: dict[str, Any] = {"name": "Lamp", "kind": "POINT", "matrix": STRAIGHT_DOWN, "strength": [4.0, 2.0, 0.0]}
LAMP |= {"normalize": True, "angle": 0.0, **SPOT, **AREA}


@pytest.fixture
def emitters(tmp_path: Path) -> Callable[..., list[Any]]:
    """Function (numbers of a lamp) → Mitsuba's emitters of it."""

    kept: list[Any] = []

    def make(**numbers: Any) -> list[Any]:
        from photonfarm.renderer.scene.loading import threads_to_read_with

        scene = ImportedScene()
        lamps = blender.Lamps(scene, tmp_path)
        lamps.put(LAMP | numbers)
        lamps.put_sky([0.0, 0.0, 0.0])
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


def test_a_soft_sun_is_a_disc_of_the_sky(emitters: Callable[..., Any]) -> None:
    leaning = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0], [0, 0, 0, 1]])
    (sky,) = emitters(kind="SUN", angle=0.5, matrix=leaning.tolist())
    seen = mi.SurfaceInteraction3f()
    radiance = {}
    for name, tilt in (("middle", 0.0), ("inside", 0.22), ("outside", 0.28)):
        axis = leaning[:3, :3] @ (np.sin(tilt), 0, np.cos(tilt))
        seen.wi = -mi.Vector3f([float(axis[0]), float(axis[2]), -float(axis[1])])
        radiance[name] = np.array(sky.eval(seen)).ravel()
    assert radiance["middle"] == pytest.approx(np.array([4, 2, 0]) / (np.pi * np.sin(0.25) ** 2), rel=5e-3)
    assert radiance["inside"] == pytest.approx(radiance["middle"], rel=1e-4)
    assert radiance["outside"] == pytest.approx([0, 0, 0], abs=1e-4)


def test_the_cone_of_a_spot_is_that_of_cycles_and_is_squeezed_by_its_scale(emitters: Callable[..., Any]) -> None:
    spots = emitters(kind="SPOT", matrix=np.diag([2.0, 1, 1, 1]).tolist(), spot_size=np.radians(60), spot_blend=0.5)
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


@pytest.mark.parametrize(("strength", "lost"), [(0.0, []), (-1.0, ["energy"])])
def test_what_no_light_is_here_is_a_loss_and_dark_lamps_are_not(
    tmp_path: Path, strength: float, lost: list[str]
) -> None:
    scene = ImportedScene()
    blender.Lamps(scene, tmp_path).put(LAMP | {"strength": [strength] * 3})
    assert [(change.effect, change.name, *change.places) for change in scene.changes] == [
        ("light", name, "lamp 'Lamp'") for name in lost
    ]


def radiance_from(scene: Any, origin: list[float], target: list[float]) -> np.ndarray:
    """The mean radiance of a field of view of 10°."""
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "perspective", "fov": 10, "to_world": to_world, "film": film})
    image = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "path"}), spp=512)
    return np.array(image).mean(axis=(0, 1))


@pytest.mark.slow
def test_area_lights_are_as_in_cycles(case: Callable[[str], Path], tmp_path: Path, loaded: Loaded, run: Run) -> None:
    run(case("blender-area-light/make.py").read_text(), str(tmp_path))
    wanted: dict[str, tuple[Any, Any]] = {
        "base": (63.7, 0.90),
        "scaled": (15.9, 0.828),
        "exposure": (254.6, 3.60),
        "unnormalized": (15.9, 0.225),
        "temperature": ((112.7, 53.7, 17.3), (1.595, 0.760, 0.245)),
        "spread": (None, 21.8),
    }
    for name, (emission, radiance) in wanted.items():
        made, scene = loaded(tmp_path / f"{name}.blend")
        assert not [change for change in made.changes if change.effect]
        found = radiance_from(scene, [1.8, 1.6, -1.2], [1.8, 0, -1.2])
        assert found == pytest.approx(np.broadcast_to(radiance, 3), rel=0.04), name
        if emission is not None:
            hit = scene.ray_intersect(mi.Ray3f([1.8, 1.6, -1.2], [0, 1, 0]))
            emitted = np.array(hit.emitter(scene).eval(hit)).ravel()
            assert emitted == pytest.approx(np.broadcast_to(emission, 3), rel=0.01)
        else:
            assert any("Lamp" in place for change in made.changes for place in change.places)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "colour"), [("default", (1, 1, 1)), ("kelvin", (1.771, 0.844, 0.272))])
def test_the_start_up_scene_has_its_lamp_and_its_grey_sky(
    case: Callable[[str], Path], tmp_path: Path, loaded: Loaded, run: Run, name: str, colour: tuple[float, ...]
) -> None:
    run(case(f"blender-{name}/make.py").read_text(), str(tmp_path))
    made, scene = loaded(tmp_path / f"{name}.blend")
    assert not [change for change in made.changes if change.effect]
    (lamp,) = [shape for shape in scene.shapes() if shape.is_emitter()]
    power = np.array(mi.traverse(lamp.emitter())["radiance.value"]).ravel() * np.pi * float(lamp.surface_area()[0])
    assert power == pytest.approx(1000 * np.array(colour), rel=1e-3)
    assert from_sky(scene, np.array([[0, 1, 0]]))[0] == pytest.approx([0.05088] * 3, rel=1e-3)
    assert made.camera == pytest.approx((7.359, 4.958, 6.926), abs=1e-3)


def test_a_fault_of_blenders_exporter_is_not_told_as_one_of_reading(tmp_path: Path, monkeypatch: Any) -> None:
    program = tmp_path / "blender"
    program.write_text("#!/bin/sh\necho 'fault: Blender reads it, but its exporter to glTF fails: no'\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv(blender.VARIABLE, str(program))
    with pytest.raises(SpecError, match=r"den\.blend: Blender reads it, but its exporter to glTF fails: no$"):
        blender.read(tmp_path / "den.blend", tmp_path, lambda _: None)


DRAWN = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 5))
cube = bpy.context.object
cube.name = "Box"
cube.modifiers.new("smooth", "ARRAY").count = 3
bpy.ops.mesh.primitive_cube_add(size=1, location=(9, 0, 0))
subdivided = bpy.context.object
subdivided.name = "Ball"
levels = subdivided.modifiers.new("subdivided", "SUBSURF")
levels.levels, levels.render_levels = 0, 2
kept = bpy.data.collections.new("Kept")
bpy.ops.mesh.primitive_plane_add(size=1)
plane = bpy.context.object
scene.collection.objects.unlink(plane)
kept.objects.link(plane)
for x in (20, 22, 24):
    holder = bpy.data.objects.new(f"Holder {x}", None)
    holder.instance_type, holder.instance_collection = "COLLECTION", kept
    holder.location, holder.scale = (x, 0, 0), (1, 2, 1)
    scene.collection.objects.link(holder)
parent = bpy.data.objects.new("Skewed", None)
parent.scale = (1, 3, 1)
scene.collection.objects.link(parent)
leaning = bpy.data.objects.new("Leaning", plane.data)
leaning.parent, leaning.rotation_euler, leaning.location = parent, (0, 0, 0.7), (30, 0, 0)
scene.collection.objects.link(leaning)
hidden = bpy.data.objects.new("Hidden", plane.data)
hidden.hide_render = True
scene.collection.objects.link(hidden)
bpy.ops.mesh.primitive_plane_add(size=1, location=(50, 0, 0))
rug = bpy.context.object
rug.name, rug.show_instancer_for_render = "Rug", False
rug.modifiers.new("fur", "PARTICLE_SYSTEM").particle_system.settings.type = "HAIR"
scene.unit_settings.scale_length = 0.01
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


@pytest.mark.slow
def test_all_that_blender_draws_is_there_and_what_is_missing_is_named(tmp_path: Path, loaded: Loaded, run: Run) -> None:
    file = tmp_path / "drawn.blend"
    run(DRAWN, str(file))
    made, scene = loaded(file)
    area = {shape.id(): float(shape.surface_area()[0]) for shape in scene.shapes()}
    assert area["Box"] == pytest.approx(18)
    assert area["Leaning"] == pytest.approx(3, rel=1e-5)
    assert [area[name] for name in ("Plane", "Plane_001")] == pytest.approx([2, 2])
    assert {made.objects[name] for name in ("Plane", "Plane_001")} == {"Holder 20", "Holder 22"}
    assert "Hidden" not in area
    ball = next(shape for shape in scene.shapes() if shape.id() == "Ball")
    assert ball.face_count() == 6 * 16 * 2  # as for renders, not for the window
    said = {(change.effect, change.name): change.places for change in made.changes}
    assert said["geometry", "HAIR"] == ["object 'Rug'"]
    assert (None, "scale_length") in said


SURFACES = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)

def surface(x, name, kind, links=(), **values):
    bpy.ops.mesh.primitive_plane_add(size=1, location=(x, 0, 0))
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    if kind:
        shader = tree.nodes.new(kind)
        for key, value in values.items():
            shader.inputs[key.replace("_", " ")].default_value = value
        tree.links.new(shader.outputs[0], output.inputs["Surface"])
        for node_kind, target in links:
            node = tree.nodes.new(node_kind)
            if node_kind == "ShaderNodeRGB":
                node.outputs[0].default_value = (0.1, 0.6, 0.2, 1)
            tree.links.new(node.outputs[0], shader.inputs[target])
    bpy.context.object.data.materials.append(material)

surface(0, "dull", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.3, 0.1, 1))
surface(1, "lit", "ShaderNodeEmission", Color=(1, 0.5, 0.25, 1), Strength=4)
surface(2, "constant", "ShaderNodeBsdfDiffuse", [("ShaderNodeRGB", "Color")])
surface(3, "cloudy", "ShaderNodeBsdfPrincipled", [("ShaderNodeTexNoise", "Base Color")])
surface(4, "waxen", "ShaderNodeBsdfPrincipled", Subsurface_Weight=0.5)
surface(5, "cloth", "ShaderNodeBsdfSheen")
surface(12, "tinted", "ShaderNodeBsdfPrincipled", Specular_Tint=(1, 0.2, 0.2, 1))
surface(13, "varnished", "ShaderNodeBsdfPrincipled", Coat_Weight=1, Coat_Tint=(1, 0.6, 0.2, 1))
surface(6, "none", "")
surface(7, "glass", "ShaderNodeBsdfGlass", Roughness=0, IOR=1.4)
surface(8, "leaf", "ShaderNodeBsdfPrincipled", [("ShaderNodeTexImage", "Base Color")])
image = bpy.data.images.new("leaf", 2, 2, alpha=True)
image.pixels = [0.5, 0.5, 0.5, 1, 0.5, 0.5, 0.5, 0] * 2
image.pack()
tree = bpy.data.materials["leaf"].node_tree
of = {node.type: node for node in tree.nodes}
of["TEX_IMAGE"].image = image
tree.links.new(of["TEX_IMAGE"].outputs["Alpha"], of["BSDF_PRINCIPLED"].inputs["Alpha"])
surface(15, "film", "ShaderNodeBsdfTransparent", Color=(1, 0.2, 0.2, 1))
surface(16, "twice", "ShaderNodeAddShader", [("ShaderNodeEmission", 0), ("ShaderNodeEmission", 1)])
surface(18, "glowing", "ShaderNodeAddShader", [("ShaderNodeBsdfDiffuse", 0), ("ShaderNodeEmission", 1)])
surface(19, "gauze", "ShaderNodeMixShader", [("ShaderNodeBsdfDiffuse", 1), ("ShaderNodeBsdfTransparent", 2)], Fac=0.25)
lamp = bpy.data.lights.new("Mixed", "POINT")
lamp.use_nodes, lamp.shadow_soft_size, lamp.energy = True, 0, 40
bpy.context.scene.collection.objects.link(bpy.data.objects.new("Mixed", lamp))
tree = lamp.node_tree
mixed = tree.nodes.new("ShaderNodeMixShader")
mixed.inputs[0].default_value = 0.25
for number, strength in ((1, 2), (2, 6)):
    shader = tree.nodes.new("ShaderNodeEmission")
    shader.inputs["Strength"].default_value = strength
    tree.links.new(shader.outputs[0], mixed.inputs[number])
tree.links.new(mixed.outputs[0], tree.get_output_node("CYCLES").inputs["Surface"])
surface(17, "fog", "")
tree = bpy.data.materials["fog"].node_tree
tree.links.new(tree.nodes.new("ShaderNodeVolumeScatter").outputs[0], tree.get_output_node("CYCLES").inputs["Volume"])
world = bpy.data.worlds.new("World")
world.use_nodes = True
tree = world.node_tree
background = tree.get_output_node("CYCLES").inputs["Surface"].links[0].from_node
direction = tree.nodes.new("ShaderNodeTexCoord")
tree.links.new(direction.outputs["Generated"], background.inputs["Color"])
bpy.context.scene.world = world
bpy.context.scene.view_settings.exposure = 1.5
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


@pytest.mark.slow
def test_surfaces_and_the_world_come_over_and_what_does_not_is_said(tmp_path: Path, loaded: Loaded, run: Run) -> None:
    file = tmp_path / "surfaces.blend"
    run(SURFACES, str(file))
    made, scene = loaded(file)

    def down(x: float) -> Any:
        return scene.ray_intersect(mi.Ray3f([x + 0.1, 3, 0.1], [0, -1, 0]))

    for x, colour in ((0, (0.6, 0.3, 0.1)), (2, (0.1, 0.6, 0.2)), (6, (0, 0, 0))):
        found = np.array(down(x).bsdf().eval_diffuse_reflectance(down(x))).ravel()
        assert found == pytest.approx(colour, abs=1e-3)
    for direction in (-1, 1):
        hit = scene.ray_intersect(mi.Ray3f([1.1, -3 * direction, 0.1], [0, direction, 0]))
        assert np.array(hit.emitter(scene).eval(hit)).ravel() == pytest.approx([4, 2, 1], rel=1e-5)
    assert "Dielectric" in str(down(7).bsdf())
    assert np.array(down(18).emitter(scene).eval(down(18))).ravel() == pytest.approx([1, 1, 1])
    assert np.array(down(19).bsdf().eval_null_transmission(down(19))).ravel() == pytest.approx([0.25] * 3)
    (lamp,) = (emitter for emitter in scene.emitters() if emitter.class_name() == "PointLight")
    assert np.array(mi.traverse(lamp)["intensity.value"]).ravel() == pytest.approx([40 * 3 / (4 * np.pi)] * 3)
    assert not down(17).is_valid()  # what has a volume alone is seen through
    assert ("Add Shader", ["material 'twice'"]) in [(c.name, c.places) for c in made.changes if c.effect == "light"]
    for x, opacity in ((-0.35, 1), (0.15, 0)):  # of an image's own alpha
        passing = np.array(down(8 + x).bsdf().eval_null_transmission(down(8 + x))).ravel()
        assert passing == pytest.approx(1 - opacity, abs=0.01)
    assert {(change.name, *change.places) for change in made.changes if change.effect == "colour"} == {
        ("Noise Texture", "material 'cloudy'"),
        ("Subsurface Weight", "material 'waxen'"),
        ("Sheen BSDF", "material 'cloth'"),
        ("Transparent BSDF", "material 'film'"),
        ("Volume", "material 'fog'"),
        ("KHR_materials_specular", "material 'tinted'"),
        ("Coat Tint", "material 'varnished'"),
    }
    assert any("exposure of +1.5 stops" in change.meaning for change in made.changes)
    # glTF's y is Blender's z, and its −z Blender's y
    for axis, colour in (((1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, 0, 1)), ((0, 0, -1), (0, 1, 0))):
        assert from_sky(scene, np.array([axis]))[0] == pytest.approx(colour, abs=0.02)


EXCHANGED = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.world = bpy.data.worlds.new("World")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.75, 1, 1)
for x, name in ((0, "Sofa"), (4, "Chair"), (8, "Rug")):
    bpy.ops.mesh.primitive_cube_add(location=(x, 0, 1))
    bpy.context.object.name = name
bpy.ops.object.light_add(type="AREA", location=(0, 0, 3))
bpy.context.object.name = "Bulb"
bpy.ops.object.camera_add(location=(1, 2, 3))
write = bpy.ops.export_scene.fbx if sys.argv[-1].endswith("fbx") else bpy.ops.wm.usd_export
write(filepath=sys.argv[-1])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "notes"), [("usdc", "cylinders, meshes or portals"), ("fbx", "that are areas")])
def test_usd_and_fbx_have_their_names_and_usd_its_camera_and_its_sky(
    tmp_path: Path, loaded: Loaded, run: Run, ending: str, notes: str
) -> None:
    run(EXCHANGED, str(tmp_path / f"it.{ending}"))
    made, scene = loaded(tmp_path / f"it.{ending}")
    assert {"Sofa", "Chair", "Rug"} <= {shape.id() for shape in scene.shapes()}
    assert any(notes in change.meaning for change in made.changes)
    assert not [change for change in made.changes if change.effect]
    if ending == "usdc":
        assert made.camera == pytest.approx((1, 3, -2))
        assert from_sky(scene, np.array([[0, 1, 0]]))[0] == pytest.approx((0.5, 0.75, 1), abs=0.01)


@pytest.mark.skipif(not os.environ.get(blender.VARIABLE), reason=f"{blender.VARIABLE} names no Blender")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["it.blend", "it.usd", "it.fbx"])
def test_a_file_that_blender_cannot_open_is_told_in_a_sentence(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"glTF")
    with pytest.raises(SpecError, match=rf"is no \{name[2:]} file that Blender [\d.]+ reads: [^\n]+$") as error:
        blender.read(tmp_path / name, tmp_path, lambda _: None)
    assert "Error" not in str(error.value)
