"""What comes of Blender's files: all that is drawn, materials, other formats, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from blender_files import Loaded, needs_blender, run

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.readers import blender


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
bpy.ops.object.text_add(location=(0, 9, 0))
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
for name, flag in (("Hidden", "hide_render"), ("Eye", "hide_viewport")):
    made = bpy.data.objects.new(name, plane.data)
    made.location = (40, 0, 0)
    setattr(made, flag, True)
    scene.collection.objects.link(made)
hair = bpy.data.hair_curves.new("Fur")
scene.collection.objects.link(bpy.data.objects.new("Fur", hair))
bpy.ops.mesh.primitive_plane_add(size=1, location=(50, 0, 0))
rug = bpy.context.object
rug.name, rug.show_instancer_for_render = "Rug", False
rug.modifiers.new("fur", "PARTICLE_SYSTEM").particle_system.settings.type = "HAIR"
scene.unit_settings.scale_length = 0.01
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


@needs_blender
@pytest.mark.slow
def test_all_that_blender_draws_is_there_and_what_is_missing_is_named(tmp_path: Path, loaded: Loaded) -> None:
    file = tmp_path / "drawn.blend"
    run(DRAWN, tmp_path, str(file))
    made, scene = loaded(file)
    area = {shape.id(): float(shape.surface_area()[0]) for shape in scene.shapes()}
    assert area["Box"] == pytest.approx(18)
    assert area["Leaning"] == pytest.approx(3, rel=1e-5)
    assert [area[name] for name in ("Plane", "Plane_001")] == pytest.approx([2, 2])
    assert {made.objects[name] for name in ("Plane", "Plane_001")} == {"Holder 20", "Holder 22"}
    assert {"Text", "Eye"} <= area.keys()
    assert "Hidden" not in area
    ball = next(shape for shape in scene.shapes() if shape.id() == "Ball")
    assert ball.face_count() == 6 * 16 * 2  # as for renders, not for the window
    said = {(change.effect, change.name): change.places for change in made.changes}
    assert said["geometry", "CURVES"] == ["object 'Fur'"]
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
surface(10, "velvet", "ShaderNodeBsdfPrincipled", Sheen_Weight=0.5)
surface(11, "brushed", "ShaderNodeBsdfPrincipled", Anisotropic=0.5, Metallic=1)
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
surface(9, "grouped", "")
tree = bpy.data.materials["grouped"].node_tree
group = tree.nodes.new("ShaderNodeGroup")
group.node_tree = bpy.data.node_groups.new("Group", "ShaderNodeTree")
group.node_tree.interface.new_socket("BSDF", in_out="OUTPUT", socket_type="NodeSocketShader")
tree.links.new(group.outputs[0], tree.get_output_node("CYCLES").inputs["Surface"])
surface(14, "rough", "ShaderNodeBsdfDiffuse", Roughness=0.5)
surface(15, "film", "ShaderNodeBsdfTransparent", Color=(1, 0.2, 0.2, 1))
surface(16, "twice", "ShaderNodeEmission", Strength=2)
tree = bpy.data.materials["twice"].node_tree
both = tree.nodes.new("ShaderNodeAddShader")
for place in (0, 1):
    tree.links.new(tree.nodes.new("ShaderNodeEmission").outputs[0], both.inputs[place])
tree.links.new(both.outputs[0], tree.get_output_node("CYCLES").inputs["Surface"])
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


@needs_blender
@pytest.mark.slow
def test_surfaces_and_the_world_come_over_and_what_does_not_is_said(tmp_path: Path, loaded: Loaded) -> None:
    file = tmp_path / "surfaces.blend"
    run(SURFACES, tmp_path, str(file))
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
    assert not down(17).is_valid()  # what has a volume alone is seen through
    assert ("Add Shader", ["material 'twice'"]) in [(c.name, c.places) for c in made.changes if c.effect == "light"]
    for x, opacity in ((-0.35, 1), (0.15, 0)):  # of an image's own alpha
        passing = np.array(down(8 + x).bsdf().eval_null_transmission(down(8 + x))).ravel()
        assert passing == pytest.approx(1 - opacity, abs=0.01)
    assert {(change.name, *change.places) for change in made.changes if change.effect == "colour"} == {
        ("Noise Texture", "material 'cloudy'"),
        ("Subsurface Weight", "material 'waxen'"),
        ("Sheen BSDF", "material 'cloth'"),
        ("Roughness", "material 'rough'"),
        ("Transparent BSDF", "material 'film'"),
        ("Volume", "material 'fog'"),
        ("Sheen Weight", "material 'velvet'"),
        ("Anisotropic", "material 'brushed'"),
        ("KHR_materials_specular", "material 'tinted'"),
        ("Coat Tint", "material 'varnished'"),
        ("Group", "material 'grouped'"),
    }
    assert {
        "Blender's (x, y, z) is (x, z, −y) here",
        "the view's exposure of +1.5 stops is left out; photonfarm sets its own",
    } <= {change.meaning for change in made.changes}
    for axis, colour in (((1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, 0, 1)), ((0, 0, -1), (0, 1, 0))):
        sky = mi.SurfaceInteraction3f()
        sky.wi = -mi.Vector3f(*axis)  # glTF's y is Blender's z, and its -z Blender's y
        assert np.array(scene.environment().eval(sky)).ravel() == pytest.approx(colour, abs=0.02)


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


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize(("ending", "notes"), [("usdc", "cylinders, meshes or portals"), ("fbx", "that are areas")])
def test_usd_and_fbx_have_their_names_and_usd_its_camera_and_its_sky(
    tmp_path: Path, loaded: Loaded, ending: str, notes: str
) -> None:
    run(EXCHANGED, tmp_path, str(tmp_path / f"it.{ending}"))
    made, scene = loaded(tmp_path / f"it.{ending}")
    assert {"Sofa", "Chair", "Rug"} <= {shape.id() for shape in scene.shapes()}
    assert any(notes in change.meaning for change in made.changes)
    assert not [change for change in made.changes if change.effect]
    if ending == "usdc":
        assert made.camera == pytest.approx((1, 3, -2))
        sky = mi.SurfaceInteraction3f()
        sky.wi = mi.Vector3f(0, -1, 0)
        assert np.array(scene.environment().eval(sky)).ravel() == pytest.approx((0.5, 0.75, 1), abs=0.01)


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("name", ["it.blend", "it.usd", "it.fbx"])
def test_a_file_that_blender_cannot_open_is_told_in_a_sentence(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"glTF")
    with pytest.raises(SpecError, match=rf"is no \{name[2:]} file that Blender [\d.]+ reads: [^\n]+$") as error:
        blender.read(tmp_path / name, tmp_path, lambda _: None)
    assert "Error" not in str(error.value)
