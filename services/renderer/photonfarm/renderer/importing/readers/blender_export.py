"""Run by Blender's Python, not by ours: opens a .blend, USD or FBX file and writes it as GLB.

    python blender_export.py IN OUT        with the wheel `bpy`
    blender --background --factory-startup --python blender_export.py -- IN OUT

Area lights, which glTF has none of, become rectangles that emit as much. Prints `note: …` for what GLB cannot hold.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy


def main() -> None:
    """Open, mend and write."""
    source, out = sys.argv[-2:]
    _open(source)
    for scene_object in list(bpy.context.scene.objects):
        if scene_object.type == "LIGHT" and scene_object.data.type == "AREA":
            _make_rectangle(scene_object)
    _say_what_is_lost()
    bpy.ops.export_scene.gltf(
        filepath=out,
        export_format="GLB",
        export_apply=True,
        export_animations=False,
        export_cameras=True,
        export_lights=True,
        export_import_convert_lighting_mode="COMPAT",
        use_renderable=True,
    )


def _open(source: str) -> None:
    suffix = Path(source).suffix.lower()
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=source, load_ui=False)
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if suffix == ".fbx":
        newer = hasattr(bpy.ops.wm, "fbx_import")
        (bpy.ops.wm.fbx_import if newer else bpy.ops.import_scene.fbx)(filepath=source)
    else:
        bpy.ops.wm.usd_import(filepath=source)


def _make_rectangle(lamp: bpy.types.Object) -> None:
    """Put a rectangle that emits a lamp's power, P / (π · A), in its place; lamps shine along −z."""
    data = lamp.data
    across = data.size
    along = data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else data.size
    x, y = across / 2, along / 2
    mesh = bpy.data.meshes.new(lamp.name)
    mesh.from_pydata([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [], [(3, 2, 1, 0)])
    material = bpy.data.materials.new(lamp.name)
    material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (0, 0, 0, 1)
    surface.inputs["Emission Color"].default_value = (*data.color, 1)
    surface.inputs["Emission Strength"].default_value = data.energy / (math.pi * across * along)
    mesh.materials.append(material)
    made = bpy.data.objects.new(lamp.name, mesh)
    bpy.context.scene.collection.objects.link(made)
    made.matrix_world = lamp.matrix_world
    bpy.data.objects.remove(lamp)


def _say_what_is_lost() -> None:
    world = bpy.context.scene.world
    if world is not None and world.use_nodes:
        sky = next((node for node in world.node_tree.nodes if node.type == "BACKGROUND"), None)
        if sky is not None and sky.inputs["Strength"].default_value > 0:
            _note("the world's light is not carried over, as glTF has none")
    procedural = sum(
        node.type.startswith("TEX_") and node.type != "TEX_IMAGE"
        for material in bpy.data.materials
        if material.node_tree
        for node in material.node_tree.nodes
    )
    if procedural:
        _note(f"{procedural} procedural textures are not carried over; bake them to images to keep them")


def _note(sentence: str) -> None:
    sys.stdout.write(f"note: {sentence}\n")


main()
