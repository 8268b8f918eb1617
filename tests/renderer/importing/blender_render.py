"""Run by Blender's Python: makes rooms with a lamp, and says what Blender and Cycles make of files.

    python blender_render.py JOBS RESULTS        two JSON files

A job is `{"make": FILE, "lamp": {…}}` or `{"look": FILE, "views": [[origin, target], …], "pictures": FOLDER}`; with
`"sky": true` it looks below a white one. Coordinates are those of glTF, y up.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

SIZE, SAMPLES, FIELD = 24, 256, 60.0


def main() -> None:
    """Do all jobs."""
    jobs, results = map(Path, sys.argv[-2:])
    results.write_text(json.dumps([make(job) if "make" in job else look(job) for job in json.loads(jobs.read_text())]))


def make(job: dict[str, Any]) -> None:
    """Save a room of 4 × 3 × 2.5 with a table and one lamp: its `kind`, `set`, `scale`, `rotation`, `nodes`, …"""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    wanted = job["lamp"]
    is_open = wanted["kind"] == "SUN" or "world" in wanted
    _box("Room", (0, 0, 0), (4, 3, 2.5), 0.3, inward=True, is_open=is_open)
    _box("Table", (1.2, 0.8, 0), (2.4, 1.6, 0.75), 0.5)
    data = bpy.data.lights.new("Lamp", wanted["kind"])
    data.energy = 50  # watts
    for name, value in wanted.get("set", {}).items():
        setattr(data, name, value)
    lamp = bpy.data.objects.new("Lamp", data)
    lamp.location, lamp.scale = (1.8, 1.2, 2.2), wanted.get("scale", (1, 1, 1))
    lamp.rotation_euler = wanted.get("rotation", (0, 0, 0))
    _place(lamp, wanted.get("place", ""))
    if "nodes" in wanted:
        data.use_nodes = True
        _add_nodes(data.node_tree, wanted["nodes"])
    if "world" in wanted:
        _make_world(wanted["world"])
    bpy.ops.wm.save_as_mainfile(filepath=job["make"], compress=True)


def _box(
    name: str, low: tuple[float, ...], high: tuple[float, ...], grey: float, inward: bool = False, is_open: bool = False
) -> None:
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [face[::-1] for face in faces[: 5 if is_open else 6]] if inward else faces)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (grey, grey, grey, 1)
    tree.links.new(diffuse.outputs[0], tree.get_output_node("CYCLES").inputs["Surface"])
    mesh.materials.append(material)


def _place(lamp: Any, place: str) -> None:
    """Put a lamp into the scene, or into a collection there, which may be drawn by an instance alone."""
    collection = bpy.context.scene.collection
    if place:
        collection = bpy.data.collections.new("Lamps")
    if place == "instanced":
        holder = bpy.data.objects.new("Holder", None)
        holder.instance_type, holder.instance_collection = "COLLECTION", collection
        holder.location = (0.5, 0, 0)
        bpy.context.scene.collection.objects.link(holder)
    elif place:
        bpy.context.scene.collection.children.link(collection)
    collection.objects.link(lamp)


def _add_nodes(tree: Any, nodes: dict[str, Any]) -> None:
    """Set the inputs of a tree's first shader: values, or `[type of node, its first inputs]`."""
    shader = next(node for node in tree.nodes if node.type in ("EMISSION", "BACKGROUND"))
    for name, value in nodes.items():
        if isinstance(value, list) and isinstance(value[0], str):
            node = tree.nodes.new(value[0])
            for part, number in zip(node.inputs or node.outputs, value[1:], strict=False):
                if isinstance(number, (int, float)):
                    part.default_value = number
            tree.links.new(node.outputs[0], shader.inputs[name])
        else:
            shader.inputs[name].default_value = value


def _make_world(nodes: dict[str, Any]) -> None:
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    bpy.context.scene.world = world
    _add_nodes(world.node_tree, nodes)


def look(job: dict[str, Any]) -> dict[str, Any]:
    """The triangles, areas and bounds of all that is drawn; Cycles' pictures go into files of many layers."""
    _open(Path(job["look"]))
    scene = bpy.context.scene
    objects, low, high = {}, [math.inf] * 3, [-math.inf] * 3
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type != "MESH":
            continue
        mesh, matrix = instance.object.data, instance.matrix_world
        mesh.calc_loop_triangles()
        corners = [matrix @ vertex.co for vertex in mesh.vertices]
        drawn = [corners[number] for face in mesh.loop_triangles for number in face.vertices]
        sides = [(drawn[k + 1] - drawn[k]).cross(drawn[k + 2] - drawn[k]).length / 2 for k in range(0, len(drawn), 3)]
        entry = objects.setdefault(instance.object.name, {"triangles": 0, "area": 0.0})
        entry["triangles"] += len(sides)
        entry["area"] += sum(sides)
        for x, y, z in drawn:
            low = [min(a, b) for a, b in zip(low, (x, z, -y), strict=True)]
            high = [max(a, b) for a, b in zip(high, (x, z, -y), strict=True)]
    if job.get("sky"):
        _make_world({"Color": (1, 1, 1, 1)})
    views = job.get("views") or [_view(low, high)]
    pictures = [_render(scene, view, Path(job["pictures"]) / f"{number}.exr") for number, view in enumerate(views)]
    return {"objects": objects, "low": low, "high": high, "views": views, "pictures": pictures}


def _open(file: Path) -> None:
    if file.suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(file), load_ui=False)
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if file.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(file))
    else:
        bpy.ops.import_scene.gltf(filepath=str(file), export_import_convert_lighting_mode="COMPAT")


def _view(low: list[float], high: list[float]) -> list[list[float]]:
    """The view from a corner of what is drawn to its middle; from beside it if it is flat."""
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    size = [b - a for a, b in zip(low, high, strict=True)]
    away = [0.45 * part if part > 1e-3 * max(size) else 0.9 * max(size) for part in size]
    return [[a + b for a, b in zip(middle, away, strict=True)], middle]


def _render(scene: Any, view: list[list[float]], file: Path) -> str:
    origin, target = (Vector((x, -z, y)) for x, y, z in view)
    camera = bpy.data.cameras.new("looker")
    camera.angle, camera.clip_start = math.radians(FIELD), 1e-3
    scene.camera = bpy.data.objects.new("looker", camera)
    scene.collection.objects.link(scene.camera)
    scene.camera.location = origin
    scene.camera.rotation_euler = (target - origin).to_track_quat("-Z", "Y").to_euler()
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device, cycles.samples = "CYCLES", "CPU", SAMPLES
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    for name in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces", "transparent_max_bounces"):
        setattr(cycles, name, 32)
    cycles.blur_glossy = cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.pixel_filter_type = "BOX"
    render.resolution_x = render.resolution_y = SIZE
    render.resolution_percentage, render.film_transparent = 100, False
    render.use_compositing = render.use_sequencer = False
    for layer in scene.view_layers:
        layer.use_pass_diffuse_color = True
    settings = render.image_settings
    if hasattr(settings, "media_type"):  # Blender 5; its files have parts, of which Mitsuba reads the first
        settings.media_type, settings.use_exr_interleave = "MULTI_LAYER_IMAGE", True
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    render.filepath = str(file)
    bpy.ops.render.render(write_still=True)
    return str(file)


main()
